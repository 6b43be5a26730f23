//! What the capture of a scene has seen: a file beside the scene, read where the arena takes all else for solid.

use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use ring::digest;
use vizflyt_arena::config::Unseen;
use vizflyt_arena::grid::Grid;
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

/// Writes what was seen of a scene beside it, for arenas that take all else for solid: one bit a voxel of `grid`, low
/// bit first, where the scene lies at `place`. The scene must be written before.
///
/// # Errors
/// What cannot be read or written.
pub fn write_seen(scene: &Path, grid: Grid, place: ScenePlace, bits: Vec<u8>) -> Result<Seen> {
    let hash = scene_hash(scene).with_context(|| format!("cannot read {}", scene.display()))?;
    let space = SeenSpace::new(grid, place, hash, bits);
    let path = seen_path(scene);
    std::fs::write(&path, space.to_bytes())
        .with_context(|| format!("cannot write {}", path.display()))?;
    Ok(Seen { space, place })
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

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use vizflyt_arena::config::Unseen;

    use super::super::{BareArgs, load};
    use super::*;

    /// A folder with an arena around a dot, to which unseen space is solid.
    fn arena() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let dot = vizflyt_splat::Splats {
            means_m: vec![glam::Vec3::new(1.0, 2.0, 3.0)],
            scales_m: vec![glam::Vec3::splat(0.1)],
            rotations: vec![glam::Quat::IDENTITY],
            opacities: vec![0.9],
            sh_degree: 0,
            sh: vec![0.5; 3],
            antialiased: false,
        };
        let scene = folder.path().join("dot.ply");
        vizflyt_splat::ply::write(&scene, &dot).unwrap();
        let mut arena = super::super::default_arena(&dot, "dot.ply").unwrap();
        arena.occupancy.unseen = Unseen::Solid;
        std::fs::write(folder.path().join("arena.toml"), arena.to_toml().unwrap()).unwrap();
        (folder, scene)
    }

    fn write(scene: &Path) -> Seen {
        let grid = Grid::covering(DVec3::splat(-1.0), DVec3::splat(1.0), 0.5);
        let place = ScenePlace::of(&vizflyt_arena::config::SceneConfig::in_world("dot.ply"));
        write_seen(scene, grid, place, vec![0xff; 8]).unwrap()
    }

    #[test]
    fn what_was_seen_is_read_where_it_is_asked_for() {
        let (folder, scene) = arena();
        let seen = write(&scene);
        let loaded = load(folder.path(), &BareArgs::default()).unwrap();
        assert_eq!(loaded.seen, Some(seen));
        // Solid all around what was seen.
        let field = super::super::bake(&loaded.splats, &loaded.arena, loaded.seen.as_ref());
        assert!(field.unseen_voxels() > 0);
    }

    #[test]
    fn a_file_that_is_not_there_damaged_or_of_another_scene_is_refused_with_advice() {
        let (folder, scene) = arena();
        let check = |expected: &str| {
            let error = format!("{:#}", load(folder.path(), &BareArgs::default()).unwrap_err());
            assert!(error.contains(expected), "'{error}' lacks '{expected}'");
        };
        check("but there is no");
        check("vizflyt scene carve");
        write(&scene);
        let path = seen_path(&scene);
        let mut bytes = std::fs::read(&path).unwrap();
        let middle = bytes.len() - 10;
        bytes[middle] ^= 1;
        std::fs::write(&path, bytes).unwrap();
        check("its checksum does not match");
        write(&scene);
        let mut file = std::fs::read(&scene).unwrap();
        *file.last_mut().unwrap() ^= 1;
        std::fs::write(&scene, file).unwrap();
        check("was made for another scene");
    }
}
