//! How a plugin that a person starts finds the runtime that waits for it: a file per waiting runtime,
//! in a folder of the user's own, named by the process and holding the service's prefix.

use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::{fs, process};

use super::user_folder;

/// A runtime's offer to a plugin that it waits for; withdrawn when dropped.
#[derive(Debug)]
pub struct Offer {
    file: PathBuf,
}

impl Offer {
    /// Offers the service to whichever plugin of this user asks first.
    ///
    /// # Errors
    /// If the file cannot be written, or the folder is another user's.
    pub fn make(service: &str) -> io::Result<Self> {
        Self::make_in(&folder(), service, process::id())
    }

    fn make_in(folder: &Path, service: &str, pid: u32) -> io::Result<Self> {
        fs::DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
        if !is_ours(folder) {
            return Err(io::Error::new(
                io::ErrorKind::PermissionDenied,
                format!("{} belongs to another user", folder.display()),
            ));
        }
        // Written beside and moved into place, so that nobody reads half of it.
        let (file, draft) = (folder.join(pid.to_string()), folder.join(format!(".{pid}")));
        let mut writer = fs::OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(true)
            .mode(0o600)
            .open(&draft)?;
        writer.write_all(service.as_bytes())?;
        fs::rename(&draft, &file)?;
        Ok(Self { file })
    }
}

impl Drop for Offer {
    fn drop(&mut self) {
        // What stays behind is ignored as soon as this process is gone.
        let _ = fs::remove_file(&self.file);
    }
}

/// Returns the prefixes of this user's runtimes that wait for a plugin, the longest waiting first.
pub fn offers() -> Vec<String> {
    offers_in(&folder())
}

fn offers_in(folder: &Path) -> Vec<String> {
    if !is_ours(folder) {
        return Vec::new();
    }
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let mut found: Vec<_> = entries
        .flatten()
        .filter_map(|entry| {
            let pid: u32 = entry.file_name().to_str()?.parse().ok()?;
            if !Path::new(&format!("/proc/{pid}")).exists() {
                // It was killed.
                let _ = fs::remove_file(entry.path());
                return None;
            }
            let since = entry.metadata().ok()?.modified().ok()?;
            Some((since, fs::read_to_string(entry.path()).ok()?))
        })
        .collect();
    found.sort();
    found.into_iter().map(|(_, service)| service).collect()
}

fn is_ours(folder: &Path) -> bool {
    fs::symlink_metadata(folder)
        .is_ok_and(|found| found.is_dir() && found.uid() == nix::unistd::geteuid().as_raw())
}

fn folder() -> PathBuf {
    Path::new(&user_folder()).join("waiting")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder of this test's own, removed behind it.
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
    fn an_offer_stands_until_it_is_dropped() {
        let scratch = Scratch::new("stands");
        assert!(offers_in(&scratch.0).is_empty());
        let offer = Offer::make_in(&scratch.0, "vizflyt/1", process::id()).unwrap();
        assert_eq!(offers_in(&scratch.0), ["vizflyt/1"]);
        drop(offer);
        assert!(offers_in(&scratch.0).is_empty());
    }

    #[test]
    fn the_offer_of_a_killed_runtime_does_not_count() {
        let scratch = Scratch::new("killed");
        // Larger than any process id Linux gives (2^22).
        let offer = Offer::make_in(&scratch.0, "vizflyt/gone", u32::MAX).unwrap();
        std::mem::forget(offer);
        assert!(offers_in(&scratch.0).is_empty());
        assert_eq!(fs::read_dir(&scratch.0).unwrap().count(), 0);
    }

    #[test]
    fn a_link_to_elsewhere_is_not_followed() {
        let (real, link) = (Scratch::new("real"), Scratch::new("link"));
        let _offer = Offer::make_in(&real.0, "vizflyt/1", process::id()).unwrap();
        std::os::unix::fs::symlink(&real.0, &link.0).unwrap();
        assert!(offers_in(&link.0).is_empty());
        fs::remove_file(&link.0).unwrap();
    }
}
