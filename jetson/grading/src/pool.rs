//! Runs several flights at the same time, one per thread. The order in which they end affects only
//! the displayed progress.

use std::num::NonZero;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::channel;
use std::thread;

use anyhow::{Context, Result, bail};

/// Runs `work` on each of `tasks`, on `jobs` threads; returns the results in the order of the
/// tasks, or `None` if stopped earlier. Calls `notify` with each result on the calling thread.
///
/// # Errors
/// The first error of `work`; it stops the other tasks.
pub(crate) fn run<T: Sync, R: Send>(
    tasks: &[T],
    jobs: NonZero<usize>,
    stop: &AtomicBool,
    work: impl Fn(&T) -> Result<Option<R>> + Sync,
    mut notify: impl FnMut(&R),
) -> Result<Option<Vec<R>>> {
    let next = AtomicUsize::new(0);
    let mut results: Vec<Option<R>> = tasks.iter().map(|_| None).collect();
    thread::scope(|scope| {
        let (sender, done) = channel();
        for worker in 0..jobs.get().min(tasks.len()) {
            let (sender, next, work) = (sender.clone(), &next, &work);
            let fly = move || {
                while let Some(index) = claim(next, tasks.len(), stop) {
                    if sender.send((index, work(&tasks[index]))).is_err() {
                        return;
                    }
                }
            };
            thread::Builder::new()
                .name(format!("grade-{worker}"))
                .spawn_scoped(scope, fly)
                .context("cannot start a thread")?;
        }
        drop(sender);
        for (index, result) in done {
            match result {
                Ok(Some(result)) => {
                    notify(&result);
                    results[index] = Some(result);
                }
                Ok(None) => stop.store(true, Ordering::Relaxed),
                Err(error) => {
                    stop.store(true, Ordering::Relaxed);
                    return Err(error);
                }
            }
        }
        let all: Option<Vec<R>> = results.into_iter().collect();
        if all.is_none() && !stop.load(Ordering::Relaxed) {
            bail!("a flight's thread panicked; see its message above");
        }
        Ok(all)
    })
}

fn claim(next: &AtomicUsize, count: usize, stop: &AtomicBool) -> Option<usize> {
    let index = next.fetch_add(1, Ordering::Relaxed);
    (index < count && !stop.load(Ordering::Relaxed)).then_some(index)
}

#[cfg(test)]
mod tests {
    use super::*;

    const JOBS: NonZero<usize> = NonZero::new(3).unwrap();

    #[test]
    fn returns_results_in_the_order_of_the_tasks() {
        let tasks: Vec<u64> = (0..50).collect();
        let mut notified = 0;
        let stop = AtomicBool::new(false);
        let found = run(&tasks, JOBS, &stop, |n| Ok(Some(n * n)), |_| notified += 1);
        assert_eq!(found.unwrap().unwrap(), tasks.iter().map(|n| n * n).collect::<Vec<_>>());
        assert_eq!(notified, 50);
        let none = run(&[] as &[u64], JOBS, &stop, |n| Ok(Some(*n)), |_| {}).unwrap();
        assert_eq!(none, Some(Vec::new()));
    }

    #[test]
    fn stops_all_tasks_on_an_error_or_a_stop() {
        let tasks: Vec<u64> = (0..1000).collect();
        let stop = AtomicBool::new(false);
        let work = |n: &u64| if *n == 5 { bail!("five") } else { Ok(Some(*n)) };
        let error = run(&tasks, JOBS, &stop, work, |_| {}).unwrap_err();
        assert_eq!(error.to_string(), "five");
        assert!(stop.load(Ordering::Relaxed));
        let stop = AtomicBool::new(false);
        let work = |n: &u64| {
            stop.store(*n >= 7, Ordering::Relaxed);
            Ok(Some(*n))
        };
        let one = NonZero::<usize>::MIN;
        assert_eq!(run(&tasks, one, &stop, work, |_| {}).unwrap(), None);
        let ended = run(&tasks, one, &AtomicBool::new(false), |_| Ok(None::<u64>), |_| {});
        assert_eq!(ended.unwrap(), None);
    }
}
