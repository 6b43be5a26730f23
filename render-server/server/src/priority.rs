//! The priority of threads that work for pages: flights come first.

use tracing::warn;

/// Lets threads of usual priority go before this one, the more so the greater `nice` (to 19); on Linux a priority is the
/// thread's own (setpriority(2)).
pub(crate) fn give_way(nice: i32) {
    if let Err(error) = rustix::process::setpriority_process(None, nice) {
        let thread = std::thread::current();
        warn!(
            "the {} thread does not give way to flights: {error}",
            thread.name().unwrap_or("unnamed")
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_that_gives_way_leaves_the_others_as_they_are() {
        let nice = || {
            let stat = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
            // Behind the name, which may hold spaces: field 3; the priority is field 19 (proc_pid_stat(5)).
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
