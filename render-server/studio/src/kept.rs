//! Cache of generated scenes on the disk, keyed by the parameters of their generation.
//!
//! Each scene is a folder written by [`Generated::write`](vizflyt_scenes::Generated::write). Its name is a hash of the
//! parameters and of this program, so that each build has its own scenes. A scene is written to a temporary folder and
//! moved to its place when complete, with a checksum of its files. If the checksum does not match later, the scene is
//! generated again. If all scenes together exceed [`MAX_BYTES`], the least recently used ones are removed.

use std::fs::{self, File, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Context, Result};
use sha2::{Digest, Sha256};
use tracing::warn;
use vizflyt_trust::hex;

/// Cache folder of generated scenes.
#[derive(Debug)]
pub(super) struct KeptScenes {
    folder: PathBuf,
    max_bytes: u64,
}

/// Key of a generated scene: hash of its parameters and of the program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct SceneKey(String);

impl SceneKey {
    /// Returns the key for these parameters; their order matters. `None` if the program's own file cannot be read.
    pub(super) fn of(parts: &[&str]) -> Option<Self> {
        let program = std::env::current_exe().and_then(fs::metadata).ok()?;
        let build = format!("{} {} {}", program.len(), program.mtime(), program.mtime_nsec());
        let mut hash = Sha256::new();
        for part in [env!("CARGO_PKG_VERSION"), &build].iter().chain(parts) {
            hash.update((part.len() as u64).to_le_bytes());
            hash.update(part);
        }
        Some(Self(hex(&hash.finalize())))
    }
}

impl KeptScenes {
    /// Returns the user's cache: `$XDG_CACHE_HOME/vizflyt/scenes`, or under `~/.cache`. `None` if neither is known.
    pub(super) fn of_user() -> Option<Self> {
        let path =
            |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
        let caches = path("XDG_CACHE_HOME").or_else(|| Some(path("HOME")?.join(".cache")))?;
        Some(Self { folder: caches.join("vizflyt/scenes"), max_bytes: MAX_BYTES })
    }

    /// Returns the folder of a scene. If it is not in the cache, `make` generates it.
    ///
    /// # Errors
    /// The error of `make`, or a folder that cannot be written.
    pub(super) fn get(
        &self,
        key: &SceneKey,
        make: impl FnOnce(&Path) -> Result<()>,
    ) -> Result<PathBuf> {
        let place = self.folder.join(&key.0);
        match is_whole(&place) {
            Ok(true) => {
                // The modification time orders the eviction. If it cannot be set, the scene is only evicted earlier.
                let _ = File::open(&place).and_then(|file| file.set_modified(SystemTime::now()));
                return Ok(place);
            }
            Ok(false) => warn!("{} is damaged and is generated again", place.display()),
            Err(_) => {}
        }
        fs::create_dir_all(&self.folder)
            .with_context(|| format!("cannot make {}", self.folder.display()))?;
        // Other users of this computer must not read the true geometry.
        let mut aside = tempfile::Builder::new();
        let aside = aside.permissions(Permissions::from_mode(0o700)).tempdir_in(&self.folder);
        let aside =
            aside.with_context(|| format!("cannot make a folder in {}", self.folder.display()))?;
        make(aside.path())?;
        let sealed = seal(aside.path()).and_then(|()| put(aside.path(), &place));
        sealed.with_context(|| format!("cannot keep {}", place.display()))?;
        self.shrink(&place);
        Ok(place)
    }

    /// Removes the least recently used scenes until the size limit is met, but never `newest`.
    fn shrink(&self, newest: &Path) {
        let Ok(entries) = fs::read_dir(&self.folder) else { return };
        let mut scenes: Vec<_> = entries
            .filter_map(|entry| {
                let path = entry.ok()?.path();
                Some((path.metadata().ok()?.modified().ok()?, bytes_of(&path), path))
            })
            .collect();
        scenes.sort();
        let mut bytes: u64 = scenes.iter().map(|(_, bytes, _)| bytes).sum();
        for (_, len, path) in scenes {
            if bytes <= self.max_bytes {
                break;
            }
            if path != newest && fs::remove_dir_all(&path).is_ok() {
                bytes -= len;
            }
        }
    }
}

/// Moves a scene to its place and replaces a damaged one. An intact scene that another process has put there stays.
fn put(made: &Path, place: &Path) -> io::Result<()> {
    if fs::rename(made, place).is_ok() || is_whole(place).is_ok_and(|whole| whole) {
        return Ok(());
    }
    fs::remove_dir_all(place)?;
    fs::rename(made, place)
}

/// Whether the scene matches its checksum.
///
/// # Errors
/// The scene does not exist.
fn is_whole(scene: &Path) -> io::Result<bool> {
    fs::metadata(scene)?;
    let kept = fs::read_to_string(scene.join(CHECKSUM)).unwrap_or_default();
    Ok(checksum(scene).is_ok_and(|sum| sum == kept))
}

fn seal(scene: &Path) -> io::Result<()> {
    let sum = checksum(scene)?;
    File::create_new(scene.join(CHECKSUM))?.write_all(sum.as_bytes())
}

/// Returns a hash of the names and contents of all files except the checksum file.
fn checksum(scene: &Path) -> io::Result<String> {
    let paths = fs::read_dir(scene)?.map(|entry| entry.map(|entry| entry.path()));
    let mut paths = paths.collect::<io::Result<Vec<_>>>()?;
    paths.sort();
    let mut hash = Sha256::new();
    for path in paths {
        let name = path.file_name().unwrap_or_default().as_encoded_bytes();
        if name != CHECKSUM.as_bytes() {
            let bytes = fs::read(&path)?;
            hash.update((name.len() as u64).to_le_bytes());
            hash.update(name);
            hash.update((bytes.len() as u64).to_le_bytes());
            hash.update(bytes);
        }
    }
    Ok(hex(&hash.finalize()))
}

fn bytes_of(scene: &Path) -> u64 {
    let files = fs::read_dir(scene).into_iter().flatten().flatten();
    files.filter_map(|file| Some(file.metadata().ok()?.len())).sum()
}

const CHECKSUM: &str = "checksum";
/// Maximum size of the cache; a scene has about 10 MB. [bytes]
const MAX_BYTES: u64 = 256 << 20;

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn key(name: &str) -> SceneKey {
        SceneKey::of(&[name]).unwrap()
    }

    fn write(text: &str) -> impl FnOnce(&Path) -> Result<()> {
        let text = text.to_owned();
        move |folder| Ok(fs::write(folder.join("arena.toml"), text)?)
    }

    fn none(_: &Path) -> Result<()> {
        panic!("it is kept")
    }

    fn text(scene: &Path) -> String {
        fs::read_to_string(scene.join("arena.toml")).unwrap()
    }

    fn kept(max_bytes: u64) -> (tempfile::TempDir, KeptScenes) {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("not/there/yet");
        (home, KeptScenes { folder, max_bytes })
    }

    #[test]
    fn generates_a_scene_once_with_owner_only_permissions() {
        let (_home, kept) = kept(1000);
        let first = kept.get(&key("forest 7"), write("forest")).unwrap();
        assert_eq!(kept.get(&key("forest 7"), none).unwrap(), first);
        assert_eq!(text(&first), "forest");
        assert_eq!(fs::metadata(&first).unwrap().permissions().mode() & 0o777, 0o700);
        let other = kept.get(&key("forest 8"), write("other")).unwrap();
        assert_eq!((text(&first), text(&other)), ("forest".to_owned(), "other".to_owned()));
        assert_ne!(SceneKey::of(&["a", "bc"]), SceneKey::of(&["ab", "c"]));
        // No temporary folders remain.
        assert_eq!(fs::read_dir(&kept.folder).unwrap().count(), 2);
    }

    #[test]
    fn regenerates_a_damaged_scene() {
        let (_home, kept) = kept(1000);
        let damages: [fn(&Path) -> io::Result<()>; 5] = [
            |scene| fs::write(scene.join("arena.toml"), "forst"),
            |scene| fs::write(scene.join("arena.toml"), ""),
            |scene| fs::remove_file(scene.join("arena.toml")),
            |scene| fs::remove_file(scene.join(CHECKSUM)),
            |scene| fs::write(scene.join("more"), "x"),
        ];
        for damage in damages {
            let scene = kept.get(&key("forest"), write("forest")).unwrap();
            damage(&scene).unwrap();
            assert_eq!(kept.get(&key("forest"), write("forest")).unwrap(), scene);
            assert_eq!(text(&scene), "forest");
            kept.get(&key("forest"), none).unwrap();
        }
    }

    #[test]
    fn keeps_a_scene_that_another_process_stored_first() {
        let (_home, kept) = kept(1000);
        let scene = kept.get(&key("forest"), |folder| {
            kept.get(&key("forest"), write("theirs"))?;
            write("ours")(folder)
        });
        assert_eq!(text(&scene.unwrap()), "theirs");
        assert_eq!(fs::read_dir(&kept.folder).unwrap().count(), 1);
    }

    #[test]
    fn evicts_the_least_recently_used_scenes() {
        // Each scene has 10 bytes, and its checksum 64.
        let (_home, kept) = kept(3 * 74);
        let scenes = ["a", "b", "c"].map(|name| kept.get(&key(name), write("0123456789")).unwrap());
        for (scene, age_s) in scenes.iter().zip([300, 200, 100]) {
            let then = SystemTime::now() - Duration::from_secs(age_s);
            File::open(scene).unwrap().set_modified(then).unwrap();
        }
        kept.get(&key("a"), none).unwrap();
        kept.get(&key("d"), write("0123456789")).unwrap();
        assert_eq!(scenes.each_ref().map(|scene| scene.exists()), [true, false, true]);
    }

    #[test]
    fn failures_are_errors_and_leave_no_files() {
        let (home, kept) = kept(1000);
        let failed = kept.get(&key("forest"), |_| anyhow::bail!("no room"));
        assert_eq!(failed.unwrap_err().to_string(), "no room");
        assert_eq!(fs::read_dir(&kept.folder).unwrap().count(), 0);
        fs::write(home.path().join("file"), "in the way").unwrap();
        let kept = KeptScenes { folder: home.path().join("file/below"), max_bytes: 1 };
        let error = kept.get(&key("forest"), none).unwrap_err();
        assert!(error.to_string().starts_with("cannot make "), "{error}");
    }
}
