//! Memory for large results, asked for before a call begins to fill it.
//!
//! Where the system has no memory left, a call ends (see [`stop`](crate::ground::stop)), not the process: what needs much
//! of it asks by `require` whether it is to be had before it begins; for the rest there is a cushion (see
//! [`allocator`](crate::ground::allocator)), so that a call gets to its next [`poll`] and ends
//! there.

use std::mem::MaybeUninit;
#[cfg(target_os = "linux")]
use std::ptr::null_mut;

use crate::ground::allocator::{CUSHION_BYTES, KEPT_BYTES, give_back_kept, is_to_be_had};
use crate::ground::stop::{Stopped, poll, stop};

/// Ends the call where the system has not the memory for `count` items of `bytes` each, all in all.
pub(crate) fn require(count: usize, bytes: usize) {
    poll();
    if count.saturating_mul(bytes) > KEPT_BYTES {
        // What is so large finds no place in what is kept.
        give_back_kept();
    }
    match count.checked_mul(bytes) {
        Some(small) if small < CUSHION_BYTES => {}
        Some(size) if is_to_be_had(size) => {}
        _ => stop(Stopped::OutOfMemory),
    }
}

/// Ends the call where the system has not the address space to start `count` threads in: a thread that gets its stack and
/// nothing more takes the process with it.
#[cfg(target_os = "linux")]
pub(crate) fn require_threads(count: usize) {
    use std::ffi::{c_int, c_long, c_void};
    unsafe extern "C" {
        fn mmap(start: *mut c_void, size: usize, access: c_int, kind: c_int, file: c_int, at: c_long) -> *mut c_void;
        fn munmap(start: *mut c_void, size: usize) -> c_int;
    }
    /// Its stack, and room for what it starts with.
    const THREAD_BYTES: usize = 3 << 20;
    const NO_ACCESS: c_int = 0;
    const PRIVATE_AND_ANONYMOUS: c_int = 0x22;
    let size = count * THREAD_BYTES;
    // SAFETY: fresh pages, which nobody sees before they go back.
    let start = crate::ground::allocator::asked(size, || {
        match unsafe { mmap(null_mut(), size, NO_ACCESS, PRIVATE_AND_ANONYMOUS, -1, 0) } {
            refused if refused.addr() == usize::MAX => null_mut(),
            start => start.cast(),
        }
    });
    if start.is_null() {
        stop(Stopped::OutOfMemory);
    }
    // SAFETY: as above.
    unsafe { munmap(start.cast(), size) };
}

#[cfg(not(target_os = "linux"))]
pub(crate) fn require_threads(_: usize) {}

/// Room for `n` values that are all going to be written: clearing it first would take as long as writing it.
pub(crate) fn room<T: Copy>(n: usize) -> Vec<MaybeUninit<T>> {
    require(n, size_of::<T>());
    let mut values = Vec::with_capacity(n);
    // SAFETY: the capacity is there, and values that may be uninitialised need no initialising.
    unsafe { values.set_len(n) };
    values
}

/// Writes the first of `values` into a part of a room, as many as it holds.
#[inline]
pub(crate) fn fill<T: Copy>(room: &mut [MaybeUninit<T>], values: &[T]) {
    room.iter_mut().zip(values).for_each(|(r, v)| *r = MaybeUninit::new(*v));
}

/// The values of a room in which every place has been written.
///
/// # Safety
/// Every place has been written.
pub(crate) unsafe fn filled<T: Copy>(room: Vec<MaybeUninit<T>>) -> Vec<T> {
    let mut room = std::mem::ManuallyDrop::new(room);
    // SAFETY: the same allocation with the same layout; the caller vouches for the contents.
    unsafe { Vec::from_raw_parts(room.as_mut_ptr().cast(), room.len(), room.capacity()) }
}
