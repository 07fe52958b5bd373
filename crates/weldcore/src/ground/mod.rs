//! What every room stands on: threads, memory, ending a call, random numbers, robust statistics, images, transforms,
//! arithmetic for vector instructions.

pub mod allocator;
pub(crate) mod branchless;
pub mod image;
pub mod memory;
pub mod random;
pub mod robust;
pub mod stop;
pub mod threads;
pub mod transform;
