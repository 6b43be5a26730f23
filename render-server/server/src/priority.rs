//! Priority of threads that work for pages: flights have precedence.

use tracing::warn;

/// Lowers the priority of this thread by `nice` (at most 19). On Linux, a priority belongs to the thread
/// (setpriority(2)).
pub(crate) fn give_way(nice: i32) {
    if let Err(error) = rustix::process::setpriority_process(None, nice) {
        let thread = std::thread::current();
        warn!(
            "cannot lower the priority of the {} thread: {error}",
            thread.name().unwrap_or("unnamed")
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lowers_the_priority_of_only_this_thread() {
        let nice = || {
            let stat = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
            // After the name, which may contain spaces: field 3; the priority is field 19 (proc_pid_stat(5)).
            let (_, fields) = stat.rsplit_once(')').unwrap();
            fields.split_whitespace().nth(16).unwrap().parse::<i32>().unwrap()
        };
        let before = nice();
        let own = std::thread::spawn(move || {
            give_way(19);
            nice()
        });
        assert_eq!((own.join().unwrap(), nice()), (19, before));
    }
}
