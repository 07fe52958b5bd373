//! Large arrays of zeros.

/// From this size on huge pages are asked for: below, there is little to gain.
const LARGE_BYTES: usize = 4 << 20;

/// A vector of zeros for a large result. Where the system offers huge pages on request (as Linux mostly does) they are
/// requested: touching the fresh memory of a scan page by page costs more than computing what goes into it.
pub(crate) fn zeros<T: Copy + Default>(n: usize) -> Vec<T> {
    let values = vec![T::default(); n];
    let bytes = n * size_of::<T>();
    if bytes >= LARGE_BYTES {
        request_huge_pages(values.as_ptr().cast(), bytes);
    }
    values
}

#[cfg(target_os = "linux")]
fn request_huge_pages(start: *const u8, bytes: usize) {
    use std::ffi::{c_int, c_void};
    unsafe extern "C" {
        fn madvise(start: *mut c_void, length: usize, advice: c_int) -> c_int;
    }
    const MADV_HUGEPAGE: c_int = 14;
    const PAGE: usize = 4096;
    let skip = start.align_offset(PAGE);
    if skip < bytes {
        // SAFETY: the pages lie within a live allocation, and the advice changes neither their contents nor their
        // protection. A refusal leaves everything as it is, so the answer does not matter.
        unsafe { madvise(start.add(skip).cast_mut().cast(), (bytes - skip) / PAGE * PAGE, MADV_HUGEPAGE) };
    }
}

#[cfg(not(target_os = "linux"))]
fn request_huge_pages(_: *const u8, _: usize) {}

#[cfg(test)]
mod tests {
    #[test]
    fn zeros_are_zero_at_any_size() {
        for n in [0, 1, 1000, 3_000_001] {
            let values = super::zeros::<[f64; 3]>(n);
            assert_eq!(values.len(), n);
            assert!(values.iter().all(|v| *v == [0.0; 3]));
        }
    }
}
