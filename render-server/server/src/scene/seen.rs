//! What the capture of a scene has seen: a file beside the scene, read where the arena takes all else for solid.

use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use ring::digest;
use vizflyt_arena::config::Unseen;
use vizflyt_arena::seen::ScenePlace;
use vizflyt_arena::{ArenaConfig, SeenSpace};

/// Returns where the seen space of a scene lies: `hall.ply.seen` beside `hall.ply`.
pub fn seen_path(scene: &Path) -> PathBuf {
    let mut name = scene.as_os_str().to_owned();
    name.push(".seen");
    PathBuf::from(name)
}

/// Returns the hash by which seen space names its scene: the SHA-256 of the file; of a folder, of its files in the
/// order of their names.
///
/// # Errors
/// What cannot be read.
pub fn scene_hash(scene: &Path) -> std::io::Result<[u8; 32]> {
    let mut hash = digest::Context::new(&digest::SHA256);
    let mut buffer = vec![0; 1 << 20];
    let mut take = |path: &Path| -> std::io::Result<()> {
        let mut file = std::fs::File::open(path)?;
        loop {
            match file.read(&mut buffer)? {
                0 => return Ok(()),
                read => hash.update(&buffer[..read]),
            }
        }
    };
    if scene.is_dir() {
        let entries = std::fs::read_dir(scene)?.map(|entry| Ok(entry?.path()));
        let mut files: Vec<PathBuf> = entries.collect::<std::io::Result<_>>()?;
        files.sort();
        files.iter().filter(|path| path.is_file()).try_for_each(|path| take(path))?;
    } else {
        take(scene)?;
    }
    let mut bytes = [0; 32];
    bytes.copy_from_slice(hash.finish().as_ref());
    Ok(bytes)
}

/// What was seen of an arena's scene, and how that lies in the arena.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    /// The file.
    pub space: SeenSpace,
    /// Where the scene lies now.
    pub place: ScenePlace,
}

/// Returns what was seen of an arena's scene; `None` where the arena does not ask.
///
/// # Errors
/// An arena that asks, and a file that is not there, is damaged or of another scene.
pub(super) fn read(arena: &ArenaConfig, scene: &Path) -> Result<Option<Seen>> {
    if arena.occupancy.unseen == Unseen::Free {
        return Ok(None);
    }
    let path = seen_path(scene);
    let otherwise =
        "carve the scene by its capture (vizflyt scene carve), or set occupancy.unseen = \"free\"";
    if !path.is_file() {
        bail!(
            "occupancy.unseen = \"solid\", but there is no {} that says what was seen; {otherwise}",
            path.display()
        );
    }
    let about =
        std::fs::metadata(&path).with_context(|| format!("cannot read {}", path.display()))?;
    if about.len() > MAX_BYTES {
        let megabytes = about.len() >> 20;
        bail!("{} has {megabytes} MB: that is no seen space; {otherwise}", path.display());
    }
    let bytes = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let space =
        SeenSpace::from_bytes(&bytes).with_context(|| format!("cannot use {}", path.display()))?;
    let hash = scene_hash(scene).with_context(|| format!("cannot read {}", scene.display()))?;
    if *space.scene() != hash {
        bail!(
            "{} was made for another scene than {} is now; {otherwise}",
            path.display(),
            scene.display()
        );
    }
    Ok(Some(Seen { space, place: ScenePlace::of(&arena.scene) }))
}

/// As many voxels as an arena may have, one bit each, and more. [bytes]
const MAX_BYTES: u64 = 256 << 20;
