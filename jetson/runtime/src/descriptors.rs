//! Descriptors: how many this process may have.

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// Raises the soft limit to the hard one, or as far as is of use: log, images and viewers take descriptors, and a
/// login shell's 1024 are soon used up by what a stranger opens.
pub(crate) fn raise_limit() {
    let Ok((soft, hard)) = getrlimit(Resource::RLIMIT_NOFILE) else { return };
    if let Err(error) = setrlimit(Resource::RLIMIT_NOFILE, hard.min(ENOUGH).max(soft), hard) {
        tracing::debug!("the limit of {soft} descriptors stays: {error}");
    }
}

/// A limit of a billion makes some programs, started from here, close a billion descriptors.
const ENOUGH: u64 = 65_536;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_is_raised_and_not_lowered() {
        let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
        raise_limit();
        let raised = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
        assert!(raised.0 >= soft && raised.1 == hard, "{raised:?}");
    }
}
