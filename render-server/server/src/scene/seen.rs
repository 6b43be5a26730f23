//! Space that the capture of a scene has seen: a file next to the scene, for arenas that treat all other space
//! as solid.

use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use ring::digest;
use vizflyt_arena::config::Unseen;
use vizflyt_arena::grid::Grid;
use vizflyt_arena::seen::ScenePlace;
use vizflyt_arena::{ArenaConfig, SeenSpace};

/// Returns the path of a scene's seen space: `hall.ply.seen` next to `hall.ply`.
pub fn seen_path(scene: &Path) -> PathBuf {
    let mut name = scene.as_os_str().to_owned();
    name.push(".seen");
    PathBuf::from(name)
}

/// Returns the hash by which seen space identifies its scene: the SHA-256 of the file; of a folder, of its
/// files in the order of their names.
///
/// # Errors
/// Files that cannot be read.
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

/// Writes the seen space of a scene next to it, for arenas that treat all other space as solid: one bit per
/// voxel of `grid`, lowest bit first, with the scene at `place`. The scene must be written before.
///
/// # Errors
/// Files that cannot be read or written.
pub fn write_seen(scene: &Path, grid: Grid, place: ScenePlace, bits: Vec<u8>) -> Result<Seen> {
    let hash = scene_hash(scene).with_context(|| format!("cannot read {}", scene.display()))?;
    let space = SeenSpace::new(grid, place, hash, bits);
    let path = seen_path(scene);
    std::fs::write(&path, space.to_bytes())
        .with_context(|| format!("cannot write {}", path.display()))?;
    Ok(Seen { space, place })
}

/// Seen space of an arena's scene, and its placement in the arena.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    pub space: SeenSpace,
    /// Present placement of the scene.
    pub place: ScenePlace,
}

/// Returns the seen space of an arena's scene; `None` if the arena does not need it.
///
/// # Errors
/// The arena needs it, but the file is missing, damaged or of another scene.
pub(super) fn read(arena: &ArenaConfig, scene: &Path) -> Result<Option<Seen>> {
    if arena.occupancy.unseen == Unseen::Free {
        return Ok(None);
    }
    let path = seen_path(scene);
    let otherwise =
        "carve the scene by its capture (vizflyt scene carve), or set occupancy.unseen = \"free\"";
    if !path.is_file() {
        bail!(
            "occupancy.unseen = \"solid\", but there is no file {} of the seen space; {otherwise}",
            path.display()
        );
    }
    let about =
        std::fs::metadata(&path).with_context(|| format!("cannot read {}", path.display()))?;
    if about.len() > MAX_BYTES {
        let megabytes = about.len() >> 20;
        bail!(
            "{} has {megabytes} MB: that is not a file of seen space; {otherwise}",
            path.display()
        );
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

/// Maximum file size: more than one bit for each voxel that an arena may have. [bytes]
const MAX_BYTES: u64 = 256 << 20;

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use vizflyt_arena::config::Unseen;

    use super::super::{BareArgs, load};
    use super::*;

    /// Returns a folder with an arena around a dot, with solid unseen space.
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
    fn reads_the_seen_space_if_the_arena_needs_it() {
        let (folder, scene) = arena();
        let seen = write(&scene);
        let loaded = load(folder.path(), &BareArgs::default()).unwrap();
        assert_eq!(loaded.seen, Some(seen));
        // Solid everywhere around the seen space.
        let field = super::super::bake(&loaded.splats, &loaded.arena, loaded.seen.as_ref());
        assert!(field.unseen_voxels() > 0);
    }

    #[test]
    fn rejects_a_missing_damaged_or_foreign_file_with_advice() {
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
