//! Descriptors: how many this process may have, and some kept back for when they run out.

use std::fs::File;
use std::io;

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// Raises the soft limit to the hard one, or as far as is of use, and returns what it is then.
pub fn raise_limit() -> usize {
    let Ok((soft, hard)) = getrlimit(Resource::RLIMIT_NOFILE) else { return USUAL };
    let wanted = hard.min(ENOUGH).max(soft);
    let is_raised = setrlimit(Resource::RLIMIT_NOFILE, wanted, hard).is_ok();
    let limit = if is_raised { wanted } else { soft };
    usize::try_from(limit).unwrap_or(usize::MAX)
}

/// Whether an error says that there are no more descriptors: of this process, or of the system.
pub fn are_used_up(error: &io::Error) -> bool {
    use nix::errno::Errno;
    let errors = [Errno::EMFILE, Errno::ENFILE, Errno::ENOBUFS, Errno::ENOMEM];
    error.raw_os_error().is_some_and(|code| errors.contains(&Errno::from_raw(code)))
}

/// Descriptors of nothing, given up one by one when others are needed.
#[derive(Debug, Default)]
pub struct Reserve(Vec<File>);

impl Reserve {
    /// Opens as many as there should be, if there are any left.
    pub fn fill(&mut self) {
        while self.0.len() < RESERVED {
            let Ok(file) = File::open("/dev/null") else { break };
            self.0.push(file);
        }
    }

    /// Gives one up; returns whether there was one.
    pub fn release(&mut self) -> bool {
        self.0.pop().is_some()
    }
}

/// Where the system does not say.
const USUAL: usize = 1024;
/// A limit of a billion makes some programs, started from here, close a billion descriptors.
const ENOUGH: u64 = 65_536;
const RESERVED: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_is_raised_and_not_lowered() {
        let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
        let raised = raise_limit() as u64;
        assert!(raised >= soft && raised <= hard.max(soft));
        assert_eq!(getrlimit(Resource::RLIMIT_NOFILE).unwrap(), (raised, hard));
    }

    #[test]
    fn a_reserve_is_given_up_and_filled_again() {
        let mut reserve = Reserve::default();
        assert!(!reserve.release());
        reserve.fill();
        assert_eq!((0..100).filter(|_| reserve.release()).count(), RESERVED);
        reserve.fill();
        assert!(reserve.release());
    }

    #[test]
    fn only_a_lack_of_descriptors_or_memory_is_one() {
        assert!(are_used_up(&io::Error::from_raw_os_error(24)), "EMFILE");
        assert!(!are_used_up(&io::Error::from_raw_os_error(103)), "ECONNABORTED");
        assert!(!are_used_up(&io::Error::other("x")));
    }
}
