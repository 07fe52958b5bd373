//! Large arrays without the cost of fresh memory.
//!
//! The system hands out fresh memory page by page and clears each page at its first touch: for the 26 MB that decoding one
//! shot returns, that takes longer than computing what goes into them. [`Recycler`] keeps large blocks that were given
//! back for the next large result, and asks for huge pages where the system offers them on request.
//!
//! There is a cushion, too, which is given up when the system refuses: then `is_short` is true, and the call in hand ends
//! at its next [`poll`](crate::ground::stop::poll).

use std::alloc::{GlobalAlloc, Layout, System};
use std::ptr::null_mut;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicPtr, Ordering};

/// From this size on blocks are kept, and huge pages asked for: below, there is little to gain.
const LARGE_BYTES: usize = 1 << 20;
/// What is kept at most: the results of a shot of a few megapixels.
pub(super) const KEPT_BYTES: usize = 160 << 20;
const KEPT_BLOCKS: usize = 48;
/// Alignment of large blocks.
const ALIGNED: usize = 16;

/// What a call may need without asking. It is address space alone: nobody touches it.
pub(super) const CUSHION_BYTES: usize = 32 << 20;

static CUSHION: AtomicPtr<u8> = AtomicPtr::new(null_mut());
/// Whether the cushion was given up in want of memory.
static SHORT: AtomicBool = AtomicBool::new(false);

fn cushion() -> Layout {
    Layout::new::<[u8; CUSHION_BYTES]>()
}

/// Whether the system had no memory to give since the last call began.
#[inline]
pub(crate) fn is_short() -> bool {
    SHORT.load(Ordering::Relaxed)
}

/// Sees to the cushion before a call; tells whether there is memory for it.
pub(crate) fn prepare() -> bool {
    if CUSHION.load(Ordering::Relaxed).is_null() {
        // SAFETY: the layout is not empty.
        let fresh = asked(CUSHION_BYTES + 1, || unsafe { System.alloc(cushion()) });
        if fresh.is_null() {
            return false;
        }
        if CUSHION.compare_exchange(null_mut(), fresh, Ordering::AcqRel, Ordering::Acquire).is_err() {
            // SAFETY: another thread's is in place; this one was shown to nobody.
            unsafe { System.dealloc(fresh, cushion()) };
        }
    }
    SHORT.store(false, Ordering::Relaxed);
    true
}

/// Whether the system has a block of some bytes, more than none, to give.
pub(super) fn is_to_be_had(size: usize) -> bool {
    let Ok(wanted) = Layout::from_size_align(size, ALIGNED) else { return false };
    // SAFETY: the layout is not empty, and the block goes back as it came.
    unsafe {
        let start = asked(size, || System.alloc(wanted));
        if !start.is_null() {
            System.dealloc(start, wanted);
        }
        !start.is_null()
    }
}

/// A block as `ask` gets it from the system; where the system has none, again after giving back what is kept, and at last
/// the cushion. Null where all that is not enough.
pub(super) fn asked(size: usize, ask: impl Fn() -> *mut u8) -> *mut u8 {
    let mut start = ask();
    if start.is_null() && give_back_kept() {
        start = ask();
    }
    if start.is_null() && size <= CUSHION_BYTES {
        let given_up = CUSHION.swap(null_mut(), Ordering::AcqRel);
        if !given_up.is_null() {
            SHORT.store(true, Ordering::Relaxed);
            // SAFETY: it came with this layout, and is nobody's any more.
            unsafe { System.dealloc(given_up, cushion()) };
            start = ask();
        }
    }
    start
}

/// Gives the blocks that are kept back to the system, and tells whether there were any.
pub(super) fn give_back_kept() -> bool {
    let Ok(mut kept) = KEPT.try_lock() else { return false };
    let count = std::mem::take(&mut kept.count);
    kept.bytes = 0;
    for &(address, size) in kept.blocks.iter().take(count) {
        if let Ok(layout) = Layout::from_size_align(size, ALIGNED) {
            // SAFETY: it came from the system with this layout, and is off the list.
            unsafe { System.dealloc(std::ptr::with_exposed_provenance_mut(address), layout) };
        }
    }
    count > 0
}

/// The allocator of the Python module: the system's, but for large blocks, of which up to 160 MB are kept when they are
/// freed and handed out again. A Rust program may choose it, too, by `#[global_allocator]`.
#[derive(Debug)]
pub struct Recycler;

struct Kept {
    /// Address and size; the first `count` are in use.
    blocks: [(usize, usize); KEPT_BLOCKS],
    count: usize,
    bytes: usize,
}

static KEPT: Mutex<Kept> = Mutex::new(Kept { blocks: [(0, 0); KEPT_BLOCKS], count: 0, bytes: 0 });

impl Kept {
    fn take(&mut self, size: usize) -> Option<*mut u8> {
        // The last one in is the one most likely to be in the cache.
        let at = self.blocks.iter().take(self.count).rposition(|b| b.1 == size)?;
        let (address, _) = *self.blocks.get(at)?;
        self.count -= 1;
        self.blocks.copy_within(at + 1..=self.count, at);
        self.bytes -= size;
        Some(std::ptr::with_exposed_provenance_mut(address))
    }

    fn keep(&mut self, block: *mut u8, size: usize) -> bool {
        if self.bytes + size > KEPT_BYTES {
            return false;
        }
        let Some(slot) = self.blocks.get_mut(self.count) else { return false };
        *slot = (block.expose_provenance(), size);
        self.count += 1;
        self.bytes += size;
        true
    }
}

/// The layout that a large block really has: rounded up by at most an eighth, so that results of nearly the same size
/// share blocks. `None` for what the system serves alone.
fn large(layout: Layout) -> Option<Layout> {
    if layout.size() < LARGE_BYTES || layout.align() > ALIGNED {
        return None;
    }
    let grain = layout.size().checked_next_power_of_two()? / 16;
    Layout::from_size_align(layout.size().checked_next_multiple_of(grain)?, ALIGNED).ok()
}

/// A kept block. Another thread at the list, perhaps one that a fork has cut off, is not waited for.
fn recycled(block: Layout) -> Option<*mut u8> {
    KEPT.try_lock().ok()?.take(block.size())
}

// SAFETY: every block comes from `System` with the layout that `large` derives from the caller's, and goes back to it
// with the same; a kept block is in the list once, and is out of it before it is handed out.
unsafe impl GlobalAlloc for Recycler {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let Some(block) = large(layout) else { return asked(layout.size(), || unsafe { System.alloc(layout) }) };
        recycled(block).unwrap_or_else(|| {
            let fresh = asked(block.size(), || unsafe { System.alloc(block) });
            request_huge_pages(fresh, block.size())
        })
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        let Some(block) = large(layout) else {
            return asked(layout.size(), || unsafe { System.alloc_zeroed(layout) });
        };
        match recycled(block) {
            Some(start) => {
                unsafe { start.write_bytes(0, layout.size()) };
                start
            }
            None => {
                let fresh = asked(block.size(), || unsafe { System.alloc_zeroed(block) });
                request_huge_pages(fresh, block.size())
            }
        }
    }

    unsafe fn dealloc(&self, start: *mut u8, layout: Layout) {
        let Some(block) = large(layout) else { return unsafe { System.dealloc(start, layout) } };
        let kept = KEPT.try_lock().is_ok_and(|mut list| list.keep(start, block.size()));
        if !kept {
            unsafe { System.dealloc(start, block) };
        }
    }

    unsafe fn realloc(&self, start: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        let Ok(wanted) = Layout::from_size_align(size, layout.align()) else { return std::ptr::null_mut() };
        match (large(layout), large(wanted)) {
            (None, None) => asked(size, || unsafe { System.realloc(start, layout, size) }),
            (Some(old), Some(new)) if old == new => start,
            // Large blocks grow by moving their pages, not their bytes.
            (Some(old), Some(new)) => asked(new.size(), || unsafe { System.realloc(start, old, new.size()) }),
            _ => unsafe {
                let moved = self.alloc(wanted);
                if !moved.is_null() {
                    moved.copy_from_nonoverlapping(start, size.min(layout.size()));
                    self.dealloc(start, layout);
                }
                moved
            },
        }
    }
}

#[cfg(target_os = "linux")]
fn request_huge_pages(start: *mut u8, bytes: usize) -> *mut u8 {
    use std::ffi::{c_int, c_void};
    unsafe extern "C" {
        fn madvise(start: *mut c_void, length: usize, advice: c_int) -> c_int;
    }
    const MADV_HUGEPAGE: c_int = 14;
    const PAGE: usize = 4096;
    let skip = start.align_offset(PAGE);
    if !start.is_null() && skip < bytes {
        // SAFETY: the pages lie within a live allocation, and the advice changes neither their contents nor their
        // protection. A refusal leaves everything as it is, so the answer does not matter.
        unsafe { madvise(start.add(skip).cast(), (bytes - skip) / PAGE * PAGE, MADV_HUGEPAGE) };
    }
    start
}

#[cfg(not(target_os = "linux"))]
fn request_huge_pages(start: *mut u8, _: usize) -> *mut u8 {
    start
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Blocks of this test alone: no other asks for this size.
    fn layout(extra: usize) -> Layout {
        Layout::from_size_align(7 * LARGE_BYTES + extra, 8).unwrap()
    }

    #[test]
    fn a_freed_block_comes_back_for_a_result_of_nearly_its_size_and_is_cleared_where_zeros_are_asked_for() {
        unsafe {
            let first = Recycler.alloc(layout(0));
            first.write_bytes(7, layout(0).size());
            Recycler.dealloc(first, layout(0));
            let again = Recycler.alloc_zeroed(layout(0));
            assert_eq!(first, again);
            let bytes = std::slice::from_raw_parts(again, layout(0).size());
            assert!(bytes.iter().all(|b| *b == 0));
            // Shrinking and growing within the block moves nothing; beyond, the contents move along.
            again.write_bytes(5, 100);
            let same = Recycler.realloc(again, layout(0), layout(0).size() - 5);
            assert_eq!(again, same);
            let small = Recycler.realloc(same, Layout::from_size_align(layout(0).size() - 5, 8).unwrap(), 1000);
            let bytes = std::slice::from_raw_parts(small, 100);
            assert!(bytes.iter().all(|b| *b == 5));
            let large = Recycler.realloc(small, Layout::from_size_align(1000, 8).unwrap(), 9 * LARGE_BYTES);
            let larger =
                Recycler.realloc(large, Layout::from_size_align(9 * LARGE_BYTES, 8).unwrap(), 20 * LARGE_BYTES);
            let bytes = std::slice::from_raw_parts(larger, 100);
            assert!(bytes.iter().all(|b| *b == 5));
            Recycler.dealloc(larger, Layout::from_size_align(20 * LARGE_BYTES, 8).unwrap());
        }
    }

    #[test]
    fn no_more_is_kept_than_the_limit() {
        let mut kept = Kept { blocks: [(0, 0); KEPT_BLOCKS], count: 0, bytes: 0 };
        let block = std::ptr::without_provenance_mut(64);
        assert!(!kept.keep(block, KEPT_BYTES + 1));
        for _ in 0..KEPT_BLOCKS {
            assert!(kept.keep(block, LARGE_BYTES));
        }
        assert!(!kept.keep(block, LARGE_BYTES));
        assert_eq!(kept.take(3), None);
        for _ in 0..KEPT_BLOCKS {
            assert_eq!(kept.take(LARGE_BYTES), Some(block));
        }
        assert_eq!((kept.take(LARGE_BYTES), kept.bytes), (None, 0));
    }

    #[test]
    fn rounding_up_wastes_an_eighth_at_most() {
        for size in (LARGE_BYTES..40 * LARGE_BYTES).step_by(99_991) {
            let block = large(Layout::from_size_align(size, 8).unwrap()).unwrap();
            assert!(block.size() >= size && block.size() - size <= size / 8);
        }
        assert_eq!(large(Layout::from_size_align(1000, 8).unwrap()), None);
        assert_eq!(large(Layout::from_size_align(4 * LARGE_BYTES, 64).unwrap()), None);
    }
}
