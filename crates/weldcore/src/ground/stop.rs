//! Ending a computation before its end: because its caller asks for it (Ctrl-C), or for want of memory.
//!
//! A long loop calls [`poll`] between blocks of its work, on whatever thread it runs. Where the call is to end, `poll`
//! does not return: it unwinds to [`attended`], which reports why. That leaves every algorithm as it is; what it had
//! allocated is dropped on the way. Of all calls of a process one can be attended at a time, that of the thread which
//! hears signals. Its parallel loops run in a pool of their own (see [`threads`](crate::ground::threads)), so that ending it ends
//! no other thread's call; meanwhile its thread waits, and listens every `PATIENCE`.

use std::any::Any;
use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::ground::allocator;

/// How long a wish to end goes unheard at most, but for the block of work in hand.
pub(crate) const PATIENCE: Duration = Duration::from_millis(50);

/// Why a call ended before its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stopped {
    /// Its caller wished it.
    OnRequest,
    /// The system had no memory, or no thread, to give.
    OutOfMemory,
}

/// What a thread does for the attended call.
#[derive(Clone, Copy)]
enum Role {
    /// Nothing: it computes for others.
    None,
    /// It is its caller.
    Caller(Caller),
    /// It is its caller, and listens: what it hears may call the core, and such a call within the call is not attended.
    Listener,
    /// It is of its pool.
    Worker,
}

#[derive(Clone, Copy)]
struct Caller {
    hears: *const (dyn Fn() -> bool + 'static),
    next: Option<Instant>,
}

thread_local! {
    static ROLE: Cell<Role> = const { Cell::new(Role::None) };
}

/// Whether the attended call is to end.
static ENDING: AtomicBool = AtomicBool::new(false);

/// Makes this thread one of the attended call's pool.
pub(crate) fn become_worker() {
    ROLE.set(Role::Worker);
}

/// Whether this thread is the attended call's.
pub(crate) fn is_caller() -> bool {
    matches!(ROLE.get(), Role::Caller(_))
}

/// Ends the call that this thread works for.
pub(crate) fn stop(why: Stopped) -> ! {
    resume_unwind(Box::new(why))
}

/// Returns, unless the call that this thread works for is to end. Cheap enough for every microsecond of work.
#[inline]
pub fn poll() {
    if allocator::is_short() {
        stop(Stopped::OutOfMemory);
    }
    match ROLE.get() {
        Role::None | Role::Listener => {}
        Role::Worker => {
            if ENDING.load(Ordering::Relaxed) {
                stop(Stopped::OnRequest);
            }
        }
        Role::Caller(caller) => poll_as(caller),
    }
}

/// [`poll`], for every item of a parallel loop: `items.par_chunks(n).inspect(polled)`.
#[inline]
pub(crate) fn polled<T>(_: &T) {
    poll();
}

#[cold]
fn poll_as(caller: Caller) {
    let now = Instant::now();
    match caller.next {
        Some(next) if now < next => {}
        Some(_) => listen(),
        None => ROLE.set(Role::Caller(Caller { next: Some(now + PATIENCE), ..caller })),
    }
    if ENDING.load(Ordering::Relaxed) {
        stop(Stopped::OnRequest);
    }
}

/// Asks whether the attended call is to end, on its caller's thread.
pub(crate) fn listen() {
    let Role::Caller(caller) = ROLE.get() else { return };
    ROLE.set(Role::Listener);
    // SAFETY: `attended` borrows the closure for as long as the thread is the caller.
    let ends = unsafe { &*caller.hears }();
    ROLE.set(Role::Caller(Caller { next: Some(Instant::now() + PATIENCE), ..caller }));
    if ends {
        ENDING.store(true, Ordering::Relaxed);
    }
}

/// Runs `job`, which may be ended for want of memory; where this thread `hears` signals, also on request: `hears` is
/// called on it now and then, and tells whether the call is to end.
///
/// # Errors
/// Why the job ended before its end.
pub fn attended<R>(hears: Option<&dyn Fn() -> bool>, job: impl FnOnce() -> R) -> Result<R, Stopped> {
    /// Gives the thread its part back, whatever happens.
    struct Before(Role);
    impl Drop for Before {
        fn drop(&mut self) {
            ROLE.set(self.0);
        }
    }
    let before = Before(ROLE.get());
    if let (Some(hears), Role::None) = (hears, before.0) {
        ENDING.store(false, Ordering::Relaxed);
        // SAFETY: the pointer is used while `before` lives, which is shorter than the borrow.
        let hears = unsafe { std::mem::transmute::<*const (dyn Fn() -> bool + '_), *const dyn Fn() -> bool>(hears) };
        ROLE.set(Role::Caller(Caller { hears, next: None }));
    }
    if !allocator::prepare() {
        return Err(Stopped::OutOfMemory);
    }
    let ended = catch_unwind(AssertUnwindSafe(job));
    let heard = is_caller() && ENDING.load(Ordering::Relaxed);
    drop(before);
    match ended {
        _ if heard => Err(Stopped::OnRequest),
        Ok(result) => Ok(result),
        Err(cause) => Err(why(cause)),
    }
}

/// Why a job unwound. A panic is no reason of ours, and goes on.
fn why(cause: Box<dyn Any + Send>) -> Stopped {
    match cause.downcast::<Stopped>() {
        Ok(why) => *why,
        Err(panic) => resume_unwind(panic),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::threads;

    const LONG: usize = 100_000;

    /// How a call of a minute and more ends that is asked to end after 80 ms, and when.
    fn ended(job: impl FnOnce()) -> (Result<(), Stopped>, Duration) {
        let started = Instant::now();
        let asked = || started.elapsed() > Duration::from_millis(80);
        (attended(Some(&asked), job), started.elapsed())
    }

    // One test: there is one attended call at a time.
    #[test]
    fn a_call_ends_soon_after_it_is_asked_to_and_no_other_call_with_it() {
        let work = || std::thread::sleep(Duration::from_millis(1));
        let serial = ended(|| (0..LONG).for_each(|_| (work(), poll()).0));
        let parallel = ended(|| drop(threads::map_each(&[0; LONG], |_| work())));
        for (result, took) in [serial, parallel] {
            assert_eq!(result, Err(Stopped::OnRequest));
            assert!(took > Duration::from_millis(80) && took < Duration::from_secs(5), "{took:?}");
        }
        // The next call is none of that, nor is another thread's, nor one that is made by what was heard.
        let sum = || threads::map_each(&[0; 8], |_| std::thread::sleep(2 * PATIENCE)).len();
        assert_eq!(attended(Some(&|| false), sum), Ok(8));
        let within = Cell::new(None);
        std::thread::scope(|scope| {
            let other = scope.spawn(|| attended(None, sum));
            let hears = || {
                within.set(Some(attended(Some(&|| true), sum)));
                true
            };
            assert_eq!(attended(Some(&hears), sum), Err(Stopped::OnRequest));
            assert_eq!(other.join().unwrap(), Ok(8));
        });
        assert_eq!(within.get(), Some(Ok(8)));
    }

    #[test]
    fn a_panic_stays_a_panic() {
        let job = || resume_unwind(Box::new("not ours"));
        assert!(catch_unwind(AssertUnwindSafe(|| attended::<()>(None, job))).is_err());
    }
}
