//! Lets a plugin that was started by hand find the waiting runtime: each waiting runtime has a socket in a folder owned
//! by the user, named after its process.

use std::io;
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::{fs, process};

use nix::sys::socket::{
    AddressFamily, Backlog, SockFlag, SockType, UnixAddr, accept4, bind, connect as connect_to,
    getsockopt, listen, socket, sockopt,
};
use nix::unistd::geteuid;

use super::socket::owned;

/// Prefix of the name of an unlisted offer.
const UNLISTED: &str = "unlisted-";

/// Offer of a runtime that waits for a plugin. Withdrawn on drop.
#[derive(Debug)]
pub struct Offer {
    path: PathBuf,
}

/// Socket to which plugins connect.
#[derive(Debug)]
pub(super) struct Listener(OwnedFd);

impl Offer {
    /// Returns the value for the plugin's `--vizflyt-service`.
    pub fn service(&self) -> String {
        self.path.display().to_string()
    }

    /// Offers to the first plugin of this user that connects. An unlisted offer is found only by its path.
    pub(super) fn make(listed: bool) -> io::Result<(Self, Listener)> {
        let prefix = if listed { "" } else { UNLISTED };
        // The owner of the outer folder could replace the inner one.
        make_ours(&home())?;
        Self::make_in(&folder(), &format!("{prefix}{}", process::id()))
    }

    fn make_in(folder: &Path, name: &str) -> io::Result<(Self, Listener)> {
        static MADE: AtomicU32 = AtomicU32::new(0);
        make_ours(folder)?;
        let path = folder.join(format!("{name}-{}", MADE.fetch_add(1, Ordering::Relaxed)));
        let socket = new_socket(SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK)?;
        // Left by a killed process that had the same process id.
        let _ = fs::remove_file(&path);
        bind(socket.as_raw_fd(), &UnixAddr::new(&path)?)?;
        let offer = Self { path };
        listen(&socket, Backlog::new(1)?)?;
        Ok((offer, Listener(socket)))
    }
}

impl Drop for Offer {
    fn drop(&mut self) {
        // If the removal fails, the file is ignored after this process has ended.
        let _ = fs::remove_file(&self.path);
    }
}

impl Listener {
    /// Returns the next plugin's socket, if one of this user has connected.
    pub(super) fn accept(&mut self) -> Option<OwnedFd> {
        let socket = owned(accept4(self.0.as_raw_fd(), SockFlag::SOCK_CLOEXEC).ok()?);
        let peer = getsockopt(&socket, sockopt::PeerCredentials).ok()?;
        (peer.uid() == geteuid().as_raw()).then_some(socket)
    }
}

pub(super) fn connect(path: &Path) -> io::Result<OwnedFd> {
    let socket = new_socket(SockFlag::SOCK_CLOEXEC)?;
    connect_to(socket.as_raw_fd(), &UnixAddr::new(path)?)?;
    Ok(socket)
}

fn new_socket(flags: SockFlag) -> io::Result<OwnedFd> {
    Ok(socket(AddressFamily::Unix, SockType::SeqPacket, flags, None)?)
}

/// Returns the services of this user's runtimes that wait for a plugin, the longest waiting first.
pub fn offers() -> Vec<String> {
    if is_ours(&home()) { offers_in(&folder()) } else { Vec::new() }
}

fn offers_in(folder: &Path) -> Vec<String> {
    if !is_ours(folder) {
        return Vec::new();
    }
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let mut found: Vec<_> = entries
        .flatten()
        .filter_map(|entry| {
            let name = entry.file_name().into_string().ok()?;
            let number = name.strip_prefix(UNLISTED).unwrap_or(&name);
            let pid: u32 = number.split('-').next()?.parse().ok()?;
            if !Path::new(&format!("/proc/{pid}")).exists() {
                // The runtime was killed.
                let _ = fs::remove_file(entry.path());
                return None;
            }
            if name.starts_with(UNLISTED) {
                return None;
            }
            let since = entry.metadata().ok()?.modified().ok()?;
            Some((since, entry.path().to_str()?.to_owned()))
        })
        .collect();
    found.sort();
    found.into_iter().map(|(_, service)| service).collect()
}

/// Creates a folder unless it exists. Does not follow links.
fn make_ours(folder: &Path) -> io::Result<()> {
    match fs::DirBuilder::new().mode(0o700).create(folder) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
            let text = format!("cannot make {}: {error}", folder.display());
            Err(io::Error::new(error.kind(), text))
        }
        _ if is_ours(folder) => Ok(()),
        _ => {
            let text = format!(
                "{} belongs to another user, or is not a folder; have it removed",
                folder.display()
            );
            Err(io::Error::new(io::ErrorKind::PermissionDenied, text))
        }
    }
}

fn is_ours(folder: &Path) -> bool {
    fs::symlink_metadata(folder)
        .is_ok_and(|found| found.is_dir() && found.uid() == geteuid().as_raw())
}

fn home() -> PathBuf {
    PathBuf::from(format!("/tmp/vizflyt-{}", geteuid()))
}

fn folder() -> PathBuf {
    home().join("waiting")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Temporary folder of one test, removed on drop.
    struct Scratch(PathBuf);

    impl Scratch {
        fn new(name: &str) -> Self {
            Self(std::env::temp_dir().join(format!("vizflyt-offer-{name}-{}", process::id())))
        }
    }

    impl Drop for Scratch {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    #[test]
    fn offer_is_listed_until_it_is_dropped() {
        let scratch = Scratch::new("stands");
        assert!(offers_in(&scratch.0).is_empty());
        let (offer, mut listener) = Offer::make_in(&scratch.0, &process::id().to_string()).unwrap();
        assert_eq!(offers_in(&scratch.0), [offer.service()]);
        assert!(listener.accept().is_none());
        let _plugin = connect(&offer.path).unwrap();
        assert!(listener.accept().is_some());
        drop(offer);
        assert!(offers_in(&scratch.0).is_empty());
    }

    #[test]
    fn ignores_and_removes_the_offer_of_a_killed_runtime() {
        let scratch = Scratch::new("killed");
        // Larger than the maximum process id of Linux (2^22).
        let (offer, _) = Offer::make_in(&scratch.0, &u32::MAX.to_string()).unwrap();
        std::mem::forget(offer);
        assert!(offers_in(&scratch.0).is_empty());
        assert_eq!(fs::read_dir(&scratch.0).unwrap().count(), 0);
    }

    #[test]
    fn does_not_follow_a_link() {
        let (real, link) = (Scratch::new("real"), Scratch::new("link"));
        let _offer = Offer::make_in(&real.0, "1").unwrap();
        std::os::unix::fs::symlink(&real.0, &link.0).unwrap();
        assert!(offers_in(&link.0).is_empty());
        let error = Offer::make_in(&link.0, "1").unwrap_err();
        assert!(error.to_string().contains("another user"), "{error}");
        fs::remove_file(&link.0).unwrap();
    }
}
