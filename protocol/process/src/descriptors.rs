//! File descriptors: the limit of this process, and a reserve for when they run out.

use std::fs::File;
use std::io;

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// Raises the soft limit to the hard limit, but at most to 65536. Returns the new limit.
pub fn raise_limit() -> usize {
    let Ok((soft, hard)) = getrlimit(Resource::RLIMIT_NOFILE) else { return USUAL };
    let wanted = hard.min(ENOUGH).max(soft);
    let is_raised = setrlimit(Resource::RLIMIT_NOFILE, wanted, hard).is_ok();
    let limit = if is_raised { wanted } else { soft };
    usize::try_from(limit).unwrap_or(usize::MAX)
}

/// Whether an error means that this process or the system is out of descriptors or memory.
pub fn are_used_up(error: &io::Error) -> bool {
    use nix::errno::Errno;
    let errors = [Errno::EMFILE, Errno::ENFILE, Errno::ENOBUFS, Errno::ENOMEM];
    error.raw_os_error().is_some_and(|code| errors.contains(&Errno::from_raw(code)))
}

/// Open descriptors of `/dev/null` that can be released when others are needed.
#[derive(Debug, Default)]
pub struct Reserve(Vec<File>);

impl Reserve {
    /// Opens descriptors until the reserve is full or none are left.
    pub fn fill(&mut self) {
        while self.0.len() < RESERVED {
            let Ok(file) = File::open("/dev/null") else { break };
            self.0.push(file);
        }
    }

    /// Releases one descriptor. Returns whether there was one.
    pub fn release(&mut self) -> bool {
        self.0.pop().is_some()
    }
}

/// Assumed limit if the system does not report it.
const USUAL: usize = 1024;
/// Upper bound: with a limit of a billion, some child programs close a billion descriptors.
const ENOUGH: u64 = 65_536;
const RESERVED: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raises_the_limit_and_never_lowers_it() {
        let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
        let raised = raise_limit() as u64;
        assert!(raised >= soft && raised <= hard.max(soft));
        assert_eq!(getrlimit(Resource::RLIMIT_NOFILE).unwrap(), (raised, hard));
    }

    #[test]
    fn releases_and_refills_the_reserve() {
        let mut reserve = Reserve::default();
        assert!(!reserve.release());
        reserve.fill();
        assert_eq!((0..100).filter(|_| reserve.release()).count(), RESERVED);
        reserve.fill();
        assert!(reserve.release());
    }

    #[test]
    fn detects_a_lack_of_descriptors_or_memory() {
        assert!(are_used_up(&io::Error::from_raw_os_error(24)), "EMFILE");
        assert!(!are_used_up(&io::Error::from_raw_os_error(103)), "ECONNABORTED");
        assert!(!are_used_up(&io::Error::other("x")));
    }
}
