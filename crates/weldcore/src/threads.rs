//! The thread pool, and loops whose result does not depend on it.
//!
//! rayon's global pool deadlocks in a process that was forked after the pool had started, so each process has its own.
//! Its size is `WELDSCAN_THREADS`, else `RAYON_NUM_THREADS`, else the number of cores this process may use;
//! [`set_threads`] changes it at run time. Loops run over chunks of a fixed size, and partial results are combined in the
//! order of the chunks: the bits of a result do not depend on the number of threads.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use crate::error::{Error, Result};

/// Items per chunk in [`map_chunks`]: large enough to hide the cost of handing it out, small enough to balance.
pub const CHUNK: usize = 16 * 1024;

struct Pool {
    process: u32,
    threads: usize,
    pool: Arc<rayon::ThreadPool>,
}

static POOL: Mutex<Option<Pool>> = Mutex::new(None);
static REQUESTED: Mutex<Option<usize>> = Mutex::new(None);

fn default_threads() -> usize {
    ["WELDSCAN_THREADS", "RAYON_NUM_THREADS"]
        .iter()
        .find_map(|name| std::env::var(name).ok()?.trim().parse().ok().filter(|&n: &usize| n > 0))
        .or_else(|| std::thread::available_parallelism().ok().map(usize::from))
        .unwrap_or(1)
}

/// Sets how many threads the core uses from now on, in this process; `None` returns to the default.
///
/// # Errors
/// [`Error::OutOfRange`] for zero or more than 1024.
pub fn set_threads(threads: Option<usize>) -> Result<()> {
    if let Some(n) = threads
        && !(1..=1024).contains(&n)
    {
        return Err(Error::OutOfRange { what: "threads", expected: "1 to 1024".into(), value: n.to_string() });
    }
    *REQUESTED.lock().unwrap_or_else(PoisonError::into_inner) = threads;
    Ok(())
}

/// How many threads the core uses.
pub fn threads() -> usize {
    REQUESTED.lock().unwrap_or_else(PoisonError::into_inner).unwrap_or_else(default_threads)
}

/// Runs `job` in this process's pool: rayon calls inside it use the pool's threads.
pub fn install<R: Send>(job: impl FnOnce() -> R + Send) -> R {
    let wanted = threads();
    let pool = {
        let mut slot = POOL.lock().unwrap_or_else(PoisonError::into_inner);
        let process = std::process::id();
        // After a fork the parent's pool has no threads here: dropping it would wait for them for ever.
        if slot.as_ref().is_some_and(|p| p.process != process) {
            std::mem::forget(slot.take());
        }
        if slot.as_ref().is_none_or(|p| p.threads != wanted) {
            let built = rayon::ThreadPoolBuilder::new().num_threads(wanted).build().ok();
            *slot = built.map(|pool| Pool { process, threads: wanted, pool: Arc::new(pool) });
        }
        slot.as_ref().map(|p| p.pool.clone())
    };
    // Where no thread is to be had the job runs on the caller's.
    match pool {
        Some(pool) => pool.install(job),
        None => job(),
    }
}

/// Maps `job(start, chunk)` over chunks of [`CHUNK`] items in parallel; the results come in the order of the chunks.
pub fn map_chunks<T: Sync, R: Send>(items: &[T], job: impl Fn(usize, &[T]) -> R + Sync) -> Vec<R> {
    install(|| items.par_chunks(CHUNK).enumerate().map(|(i, chunk)| job(i * CHUNK, chunk)).collect())
}

/// Maps `job` over items that are worth a thread each; the results come in the order of the items.
pub fn map_each<T: Sync, R: Send>(items: &[T], job: impl Fn(&T) -> R + Sync) -> Vec<R> {
    install(|| items.par_iter().map(&job).collect())
}

/// Maps `job(range)` over ranges of [`CHUNK`] indices below `count` in parallel; the results come in the order of the ranges.
pub fn map_ranges<R: Send>(count: usize, job: impl Fn(std::ops::Range<usize>) -> R + Sync) -> Vec<R> {
    let range = |k: usize| k * CHUNK..((k + 1) * CHUNK).min(count);
    install(|| (0..count.div_ceil(CHUNK)).into_par_iter().map(|k| job(range(k))).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunked_sums_have_the_same_bits_on_any_number_of_threads() {
        let values: Vec<f64> = (0..200_000).map(|i| 1.0 / (1.0 + f64::from(i))).collect();
        let sum = || map_chunks(&values, |_, c| c.iter().sum::<f64>()).iter().sum::<f64>();
        let mut seen = Vec::new();
        for n in [1, 2, 8] {
            set_threads(Some(n)).unwrap();
            seen.push(sum().to_bits());
        }
        set_threads(None).unwrap();
        assert!(seen.windows(2).all(|w| w[0] == w[1]));
    }

    #[test]
    fn zero_threads_is_refused() {
        assert!(set_threads(Some(0)).is_err());
    }
}
