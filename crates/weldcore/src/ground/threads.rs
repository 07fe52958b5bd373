//! The thread pools, and loops whose result does not depend on them.
//!
//! A pool's threads do not live on in a forked process, and a lock that one of them held stays locked there. So each
//! process has its own pools and its own lock on them, reached without one. Of the two pools one is for the call that can
//! be ended (see [`stop`]), the other for all other threads' calls.
//! Their size is `WELDSCAN_THREADS`, else `RAYON_NUM_THREADS`, else the number of cores this process may use;
//! [`set_threads`] changes it at run time. Loops run over chunks of a fixed size, and partial results are combined in the
//! order of the chunks: the bits of a result do not depend on the number of threads.

use std::sync::atomic::{AtomicBool, AtomicPtr, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::ground::memory;
use crate::ground::stop::{self, Stopped, poll, polled};

/// Items per chunk in [`map_chunks`]: large enough to hide the cost of handing it out, small enough to balance.
pub const CHUNK: usize = 16 * 1024;
/// More threads than this are a mistake.
const MOST_THREADS: usize = 1024;

/// A value that is made when it is first asked for and then stays. Nobody waits for another who makes it: of two that
/// are made at once one is dropped.
pub(crate) struct Lasting<T>(AtomicPtr<T>);

impl<T: Sync + Send + 'static> Lasting<T> {
    pub(crate) const fn new() -> Self {
        Self(AtomicPtr::new(std::ptr::null_mut()))
    }

    pub(crate) fn get(&'static self, make: impl FnOnce() -> T) -> &'static T {
        let mut value = self.0.load(Ordering::Acquire);
        if value.is_null() {
            let made = Box::into_raw(Box::new(make()));
            match self.0.compare_exchange(std::ptr::null_mut(), made, Ordering::AcqRel, Ordering::Acquire) {
                Ok(_) => value = made,
                Err(before) => {
                    // SAFETY: nobody else has seen it.
                    drop(unsafe { Box::from_raw(made) });
                    value = before;
                }
            }
        }
        // SAFETY: it came from a box that is never freed.
        unsafe { &*value }
    }

    /// Leaves the value where it is, and has another made when it is next asked for.
    fn forget(&'static self) {
        self.0.store(std::ptr::null_mut(), Ordering::Release);
    }
}

struct Pool {
    threads: usize,
    pool: Arc<rayon::ThreadPool>,
}

/// What a process has and a forked one does not.
struct Process {
    default_threads: Result<usize>,
    /// The pool for all calls but one, and the pool of the attended call.
    pools: [Mutex<Option<Pool>>; 2],
}

static PROCESS: Lasting<Process> = Lasting::new();
/// 0 is the default.
static REQUESTED: AtomicUsize = AtomicUsize::new(0);

impl Process {
    fn this() -> &'static Self {
        PROCESS.get(|| {
            forget_after_fork();
            Self { default_threads: default_threads(), pools: [const { Mutex::new(None) }; 2] }
        })
    }
}

/// Sees to it that a forked process starts anew. Before the first value is there to be forgotten, and twice at worst,
/// which does no harm.
#[cfg(unix)]
fn forget_after_fork() {
    use std::ffi::c_int;
    type Handler = Option<unsafe extern "C" fn()>;
    unsafe extern "C" {
        fn pthread_atfork(prepare: Handler, parent: Handler, child: Handler) -> c_int;
    }
    unsafe extern "C" fn in_child() {
        PROCESS.forget();
    }
    static DONE: AtomicBool = AtomicBool::new(false);
    if !DONE.load(Ordering::Acquire) {
        // SAFETY: the handler stores to an atomic, which any process may do at any moment.
        unsafe { pthread_atfork(None, None, Some(in_child)) };
        DONE.store(true, Ordering::Release);
    }
}

#[cfg(not(unix))]
fn forget_after_fork() {}

fn require_threads(what: &'static str, wanted: Option<usize>, value: String) -> Result<usize> {
    wanted.filter(|n| (1..=MOST_THREADS).contains(n)).ok_or_else(|| {
        let expected = format!("1 to {MOST_THREADS}");
        Error::OutOfRange { what, expected, value }
    })
}

fn default_threads() -> Result<usize> {
    let set = |name| std::env::var(name).ok().filter(|text| !text.trim().is_empty());
    let what = "WELDSCAN_THREADS";
    if let Some(text) = set(what) {
        return require_threads(what, text.trim().parse().ok(), format!("'{}'", text.trim()));
    }
    // Another's setting, which other programs read, too: what is none is left to them.
    let others = set("RAYON_NUM_THREADS").and_then(|text| text.trim().parse().ok());
    let cores = || std::thread::available_parallelism().map_or(1, usize::from).min(MOST_THREADS);
    Ok(others.filter(|n| (1..=MOST_THREADS).contains(n)).unwrap_or_else(cores))
}

/// Sets how many threads the core uses from now on, in this process; `None` returns to the default.
///
/// # Errors
/// [`Error::OutOfRange`] for zero or more than 1024, and for a default that is.
pub fn set_threads(threads: Option<usize>) -> Result<()> {
    let wanted = threads.map(|n| require_threads("threads", Some(n), n.to_string())).transpose()?;
    REQUESTED.store(wanted.unwrap_or(0), Ordering::Relaxed);
    self::threads().map(drop)
}

/// How many threads the core uses.
///
/// # Errors
/// [`Error::OutOfRange`] where `WELDSCAN_THREADS` is not 1 to 1024.
pub fn threads() -> Result<usize> {
    match REQUESTED.load(Ordering::Relaxed) {
        0 => Process::this().default_threads.clone(),
        wanted => Ok(wanted),
    }
}

/// This process's pool for the attended call, or for all others; of another size it is built anew.
fn pool(attended: bool) -> Arc<rayon::ThreadPool> {
    let wanted = threads().unwrap_or(1);
    let [others, own] = &Process::this().pools;
    let mut slot = if attended { own } else { others }.lock().unwrap_or_else(PoisonError::into_inner);
    match slot.as_ref() {
        Some(p) if p.threads == wanted => p.pool.clone(),
        _ => {
            memory::require_threads(wanted);
            let start = move |_| {
                if attended {
                    stop::become_worker()
                }
            };
            let build = |n| rayon::ThreadPoolBuilder::new().num_threads(n).start_handler(start).build();
            // Where the system has no thread to give, it has nothing to compute with.
            let Ok(built) = build(wanted).or_else(|_| build(1)) else { stop::stop(Stopped::OutOfMemory) };
            let pool = Arc::new(built);
            *slot = Some(Pool { threads: wanted, pool: pool.clone() });
            pool
        }
    }
}

/// Runs `job` in this process's pool: rayon calls inside it use the pool's threads.
pub fn install<R: Send>(job: impl FnOnce() -> R + Send) -> R {
    poll();
    if rayon::current_thread_index().is_some() {
        return job();
    }
    if !stop::is_caller() {
        return pool(false).install(job);
    }
    let (done, mut result) = (Bell::default(), None);
    pool(true).in_place_scope(|scope| {
        scope.spawn(|_| {
            let _ring = Ring(&done);
            result = Some(job());
        });
        let process: *const Process = Process::this();
        while !done.heard_within(stop::PATIENCE) {
            stop::listen();
            // A signal's handler has forked, and this is the child: the threads at work are not here.
            if !std::ptr::eq(process, Process::this()) {
                std::process::abort();
            }
        }
    });
    // Where there is no result the scope has unwound.
    result.unwrap_or_else(|| stop::stop(Stopped::OnRequest))
}

/// Runs a job of others, in which nobody polls. Where the attended call is to end meanwhile, the job is left to itself,
/// with all that it owns.
pub(crate) fn left_to_itself<R: Send + 'static>(job: impl FnOnce() -> R + Send + 'static) -> R {
    poll();
    if !stop::is_caller() {
        return job();
    }
    memory::require_threads(1);
    let (send, receive) = std::sync::mpsc::channel();
    let run = move || drop(send.send(std::panic::catch_unwind(std::panic::AssertUnwindSafe(job))));
    let Ok(_) = std::thread::Builder::new().spawn(run) else { stop::stop(Stopped::OutOfMemory) };
    loop {
        match receive.recv_timeout(stop::PATIENCE) {
            Ok(Ok(result)) => return result,
            Ok(Err(panic)) => std::panic::resume_unwind(panic),
            Err(_) => {
                stop::listen();
                poll();
            }
        }
    }
}

/// Rings once.
#[derive(Default)]
struct Bell(Mutex<bool>, Condvar);

impl Bell {
    fn heard_within(&self, time: std::time::Duration) -> bool {
        let rung = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        *self.1.wait_timeout_while(rung, time, |rung| !*rung).unwrap_or_else(PoisonError::into_inner).0
    }
}

/// Rings the bell at its end, however it comes.
struct Ring<'a>(&'a Bell);

impl Drop for Ring<'_> {
    fn drop(&mut self) {
        *self.0.0.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.0.1.notify_one();
    }
}

/// Maps `job(start, chunk)` over chunks of [`CHUNK`] items in parallel; the results come in the order of the chunks.
pub fn map_chunks<T: Sync, R: Send>(items: &[T], job: impl Fn(usize, &[T]) -> R + Sync) -> Vec<R> {
    let chunks = || items.par_chunks(CHUNK).inspect(polled).enumerate();
    install(|| chunks().map(|(i, chunk)| job(i * CHUNK, chunk)).collect())
}

/// Maps `job` over items that are worth a thread each; the results come in the order of the items.
pub fn map_each<T: Sync, R: Send>(items: &[T], job: impl Fn(&T) -> R + Sync) -> Vec<R> {
    install(|| items.par_iter().inspect(polled).map(&job).collect())
}

/// Maps `job(range)` over ranges of [`CHUNK`] indices below `count` in parallel; the results come in the order of the ranges.
pub fn map_ranges<R: Send>(count: usize, job: impl Fn(std::ops::Range<usize>) -> R + Sync) -> Vec<R> {
    let range = |k: usize| k * CHUNK..((k + 1) * CHUNK).min(count);
    install(|| (0..count.div_ceil(CHUNK)).into_par_iter().inspect(polled).map(|k| job(range(k))).collect())
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
