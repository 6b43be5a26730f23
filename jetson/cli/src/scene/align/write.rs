//! Writes a place into an arena.toml that people have written: all else stays, comments too.

use std::path::Path;

use anyhow::{Context, Result};
use toml_edit::{Array, DocumentMut, InlineTable, Item, TableLike, Value, value};
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::{Geofence, Spawn};
use vizflyt_twin::align::Similarity;

/// What is written.
pub(super) struct Changes {
    pub place: Similarity,
    /// Where it is another than before.
    pub fence: Option<Geofence>,
    /// Likewise.
    pub spawn: Option<Spawn>,
}

/// Writes changes into an arena's file.
///
/// # Errors
/// A file that cannot be read or written, or an arena that would be none.
pub(super) fn write(path: &Path, changes: &Changes) -> Result<()> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let changed = changed(&text, changes)?;
    ArenaConfig::parse(&changed).with_context(|| {
        format!("nothing is written, for {} would not be read again", path.display())
    })?;
    std::fs::write(path, changed).with_context(|| format!("cannot write {}", path.display()))
}

/// Returns the text of an arena.toml with the changes.
fn changed(text: &str, changes: &Changes) -> Result<String> {
    let mut document: DocumentMut = text.parse()?;
    put_place(&mut document, &changes.place)?;
    if let Some(fence) = changes.fence {
        let table = table(&mut document, "geofence")?;
        set(table, "min_m", numbers(&fence.min_m.to_array()));
        set(table, "max_m", numbers(&fence.max_m.to_array()));
    }
    if let Some(spawn) = changes.spawn {
        let table = table(&mut document, "spawn")?;
        set(table, "position_m", numbers(&spawn.position_m.to_array()));
        set(table, "yaw_deg", spawn.yaw_deg.into());
    }
    Ok(document.to_string())
}

fn put_place(document: &mut DocumentMut, place: &Similarity) -> Result<()> {
    let scene = document.get_mut("scene").context("the file has no scene")?;
    if let Some(file) = scene.as_str().map(str::to_owned) {
        // The short form is a line before any table, and becomes a line there.
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

fn table<'a>(document: &'a mut DocumentMut, key: &str) -> Result<&'a mut dyn TableLike> {
    let item = document.get_mut(key).and_then(Item::as_table_like_mut);
    item.with_context(|| format!("{key} is no table"))
}

/// Sets a key; what stands about an old value stays.
fn set(table: &mut dyn TableLike, key: &str, mut new: Value) {
    if let Some(old) = table.get(key).and_then(Item::as_value) {
        *new.decor_mut() = old.decor().clone();
    }
    table.insert(key, Item::Value(new));
}

fn numbers(of: &[f64]) -> Value {
    Value::Array(of.iter().copied().collect::<Array>())
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    const PLACE: Similarity = Similarity {
        scale: 0.25,
        rotation: DQuat::from_xyzw(0.6, 0.0, 0.0, 0.8),
        translation_m: DVec3::new(1.0, -2.0, 0.5),
    };

    #[test]
    fn a_place_is_written_and_all_else_stays() {
        let rest = "\n# The net.\n[geofence]\nmin_m = [0, 0, 0]   # west\nmax_m = [9, 4, 3]\n";
        for scene in [
            "scene = \"room.ply\" # captured\n",
            "[scene]\nfile = \"room.ply\"\nup = \"-y\"\nyaw_deg = 4.0\n",
        ] {
            // A table of its own comes after the lines of the root.
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
    fn fence_and_start_are_written_and_comments_stay() {
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
