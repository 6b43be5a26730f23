//! Writes an alignment into an existing arena.toml. All other keys and all comments stay.

use std::path::Path;

use anyhow::{Context, Result};
use toml_edit::{DocumentMut, InlineTable, value};
use vizflyt_arena::config::{Geofence, Spawn};
use vizflyt_twin::align::Similarity;

use crate::arena::file::{self, numbers, set, table};

/// Changes of an arena.toml.
pub(super) struct Changes {
    pub place: Similarity,
    /// New fence, if it changed.
    pub fence: Option<Geofence>,
    /// New start, if it changed.
    pub spawn: Option<Spawn>,
}

/// Writes changes into the file of an arena.
///
/// # Errors
/// The file cannot be read or written, or the arena would be invalid.
pub(super) fn write(path: &Path, changes: &Changes) -> Result<()> {
    file::change(path, |document| put(document, changes))
}

fn put(document: &mut DocumentMut, changes: &Changes) -> Result<()> {
    put_place(document, &changes.place)?;
    if let Some(fence) = changes.fence {
        file::put(document, "geofence", &fence)?;
    }
    if let Some(spawn) = changes.spawn {
        file::put(document, "spawn", &spawn)?;
    }
    Ok(())
}

fn put_place(document: &mut DocumentMut, place: &Similarity) -> Result<()> {
    let scene = document.get_mut("scene").context("the file has no scene")?;
    if let Some(file) = scene.as_str().map(str::to_owned) {
        // The short form `scene = "..."` precedes all tables. An inline table can replace it there.
        let mut long = InlineTable::new();
        long.insert("file", file.into());
        *scene = value(long);
    }
    let table = table(document, "scene")?;
    for key in ["up", "yaw_deg"] {
        table.remove(key);
    }
    set(table, "rotation", numbers(&place.rotation.to_array()));
    set(table, "metres_per_unit", place.scale.into());
    set(table, "origin", numbers(&place.translation_m.to_array()));
    Ok(())
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    fn changed(text: &str, changes: &Changes) -> Result<String> {
        let mut document: DocumentMut = text.parse()?;
        put(&mut document, changes)?;
        Ok(document.to_string())
    }

    const PLACE: Similarity = Similarity {
        scale: 0.25,
        rotation: DQuat::from_xyzw(0.6, 0.0, 0.0, 0.8),
        translation_m: DVec3::new(1.0, -2.0, 0.5),
    };

    #[test]
    fn writes_the_placement_and_keeps_the_rest() {
        let rest = "\n# The net.\n[geofence]\nmin_m = [0, 0, 0]   # west\nmax_m = [9, 4, 3]\n";
        for scene in [
            "scene = \"room.ply\" # captured\n",
            "[scene]\nfile = \"room.ply\"\nup = \"-y\"\nyaw_deg = 4.0\n",
        ] {
            // Both forms of `scene`: as a string and as a table.
            let text = format!("name = \"hall\"\n{scene}{rest}");
            let changes = Changes { place: PLACE, fence: None, spawn: None };
            let placed = changed(&text, &changes).unwrap();
            assert!(placed.contains(rest), "{placed}");
            let read: toml_edit::DocumentMut = placed.parse().unwrap();
            let scene = &read["scene"];
            assert_eq!(scene["file"].as_str(), Some("room.ply"));
            assert_eq!(scene["metres_per_unit"].as_float(), Some(0.25));
            assert!(scene.get("up").is_none() && scene.get("yaw_deg").is_none(), "{placed}");
            let origin: Vec<_> = scene["origin"].as_array().unwrap().iter().collect();
            assert_eq!(origin[1].as_float(), Some(-2.0));
        }
    }

    #[test]
    fn writes_fence_and_start_and_keeps_comments() {
        let text = "scene = { file = \"a.ply\", up = \"-y\", antialiased = true, crop = { min_m = [0, 0, 0], \
                    max_m = [1, 1, 1] } }\nspawn = { position_m = [1, 2, 0] } # the mat\n\n# The net.\n[geofence]\n\
                    min_m = [0, 0, 0]   # west\nmax_m = [9, 4, 3]\n";
        let fence = Geofence { min_m: DVec3::splat(-2.0), max_m: DVec3::splat(2.5) };
        let spawn = Spawn { position_m: DVec3::X, yaw_deg: 90.0 };
        let changes = Changes { place: PLACE, fence: Some(fence), spawn: Some(spawn) };
        let changed = changed(text, &changes).unwrap();
        for kept in ["# The net.", "# west", "# the mat", "antialiased = true", "crop = {"] {
            assert!(changed.contains(kept), "{kept} is gone: {changed}");
        }
        let read: DocumentMut = changed.parse().unwrap();
        assert_eq!(read["geofence"]["min_m"][1].as_float(), Some(-2.0));
        assert_eq!(read["geofence"]["max_m"][2].as_float(), Some(2.5));
        assert_eq!(read["spawn"]["yaw_deg"].as_float(), Some(90.0));
        assert!(read["scene"].get("up").is_none());
    }
}
