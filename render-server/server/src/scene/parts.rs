//! Named parts of a scene, given by boxes, for scenes without known geometry. `vizflyt dataset --parts` reads
//! them, and `vizflyt scene edit --page` creates them from a selection.
//!
//! ```toml
//! [[parts]]
//! name = "window 1"    # of a stage: then its pose and corners come from the arena
//! class = "gate"
//! center_m = [3.0, 0.4, 1.3]
//! size_m = [0.3, 1.6, 1.6]
//! yaw_deg = 12.0
//! ```
//! A splat belongs to the first box that contains its centre.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_splat::Splats;

use super::edit::{file_name, replace};

/// File of named parts.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartsFile {
    /// Parts in order: a splat belongs to the first that contains it.
    pub parts: Vec<BoxedPart>,
}

/// Named box.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoxedPart {
    /// Unique name.
    pub name: String,
    /// Class of the object: one of the data set's, or a custom one.
    #[serde(default = "part")]
    pub class: String,
    /// Centre. [m, world]
    pub center_m: DVec3,
    /// Side lengths. [m]
    pub size_m: DVec3,
    /// Rotation about z. [deg]
    #[serde(default)]
    pub yaw_deg: f64,
}

fn part() -> String {
    "part".to_owned()
}

/// Returns the path of a scene's parts: next to it, with its full name.
pub fn parts_path(scene: &Path) -> PathBuf {
    scene.with_file_name(format!("{}.parts.toml", file_name(scene)))
}

impl BoxedPart {
    /// Returns the smallest upright box around points, with the best rotation about z. From 200 points on, a
    /// hundredth at each end of each side is left out, because captures contain strays.
    ///
    /// # Errors
    /// Fewer than four points.
    pub fn about(name: &str, class: &str, points_m: &[DVec3]) -> Result<Self> {
        ensure!(points_m.len() >= 4, "{} splats are too few to name", points_m.len());
        let strays = if points_m.len() < 200 { 0 } else { points_m.len() / 100 };
        let mut along: Vec<f64> = Vec::with_capacity(points_m.len());
        // Corners of the box, in axes rotated by an angle.
        let mut ends = |turn: DQuat| {
            let mut ends = [DVec3::ZERO; 2];
            for axis in 0..3 {
                along.clear();
                along.extend(points_m.iter().map(|p_m| (turn.conjugate() * *p_m)[axis]));
                along.sort_unstable_by(f64::total_cmp);
                ends[0][axis] = along[strays];
                ends[1][axis] = along[along.len() - 1 - strays];
            }
            ends
        };
        let mut best = (f64::INFINITY, 0.0);
        for deg in -45..45 {
            let yaw_deg = f64::from(deg);
            let [low, high] = ends(DQuat::from_rotation_z(yaw_deg.to_radians()));
            let side = high - low;
            if side.x * side.y < best.0 {
                best = (side.x * side.y, yaw_deg);
            }
        }
        let yaw_deg = best.1;
        let world_from_box = DQuat::from_rotation_z(yaw_deg.to_radians());
        let [low, high] = ends(world_from_box);
        // Rounded to millimetres for readability, with a margin of a centimetre.
        let rounded = |v: DVec3| (v * 1e3).round() / 1e3;
        Ok(Self {
            name: name.to_owned(),
            class: class.to_owned(),
            center_m: rounded(world_from_box * ((low + high) / 2.0)),
            size_m: rounded(high - low + 0.02),
            yaw_deg,
        })
    }
}

impl std::fmt::Display for BoxedPart {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { name, class, size_m, .. } = self;
        write!(f, "{name} ({class}): {:.2} x {:.2} x {:.2} m", size_m.x, size_m.y, size_m.z)
    }
}

impl PartsFile {
    /// Reads a file of parts.
    ///
    /// # Errors
    /// The file cannot be read or is invalid; names its line or its part.
    pub fn read(path: &Path) -> Result<Self> {
        let context = || format!("cannot use {} as --parts", path.display());
        let text = std::fs::read_to_string(path).with_context(context)?;
        Self::parse(&text).with_context(context)
    }

    fn parse(text: &str) -> Result<Self> {
        let file: Self = vizflyt_toml::parse(text)?;
        file.check()?;
        Ok(file)
    }

    fn check(&self) -> Result<()> {
        for (n, part) in self.parts.iter().enumerate() {
            let BoxedPart { name, class, center_m, size_m, yaw_deg } = part;
            ensure!(
                !name.is_empty() && !class.is_empty(),
                "part {}: give a name and a class",
                n + 1
            );
            let known = self.parts[..n].iter().any(|other| other.name == *name);
            ensure!(!known, "two parts are called '{name}'; give each its own name");
            ensure!(
                size_m.cmpgt(DVec3::ZERO).all() && size_m.is_finite() && center_m.is_finite(),
                "part '{name}': size_m = {size_m} about {center_m} is not a valid box; sides must be above 0, in metres"
            );
            ensure!(yaw_deg.is_finite(), "part '{name}': yaw_deg = {yaw_deg} is not finite");
        }
        ensure!(self.parts.len() <= 10_000, "{} parts are more than 10,000", self.parts.len());
        Ok(())
    }

    /// Adds a part, or replaces the one with its name, and writes the file.
    ///
    /// # Errors
    /// The part is invalid, or the file cannot be written. Then nothing is changed.
    pub fn put(&mut self, part: BoxedPart, path: &Path) -> Result<()> {
        let mut next = self.clone();
        match next.parts.iter_mut().find(|known| known.name == part.name) {
            Some(known) => *known = part,
            None => next.parts.push(part),
        }
        next.check()?;
        let text = toml::to_string(&next).context("cannot write the parts as TOML")?;
        let text = format!("# vizflyt dataset --scene ... --parts {}\n\n{text}", file_name(path));
        replace(path, &text).with_context(|| format!("cannot write {}", path.display()))?;
        *self = next;
        Ok(())
    }

    /// Returns the index of the part of each splat.
    pub fn label(&self, splats: &Splats) -> Vec<Option<usize>> {
        let boxes: Vec<(DQuat, &BoxedPart)> = self
            .parts
            .iter()
            .map(|part| (DQuat::from_rotation_z(-part.yaw_deg.to_radians()), part))
            .collect();
        let of = |mean_m: &glam::Vec3| {
            boxes.iter().position(|(part_from_world, part)| {
                let offset_m = *part_from_world * (mean_m.as_dvec3() - part.center_m);
                offset_m.abs().cmple(part.size_m / 2.0).all()
            })
        };
        splats.means_m.iter().map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use proptest::prelude::*;

    const GOOD: &str =
        "[[parts]]\nname = \"table\"\ncenter_m = [1, 0, 0]\nsize_m = [2, 0.2, 1]\nyaw_deg = 90\n";

    #[test]
    fn splats_belong_to_the_first_box_about_them() {
        let more = format!(
            "{GOOD}[[parts]]\nname = \"all\"\nclass = \"rest\"\ncenter_m = [0, 0, 0]\nsize_m = [9, 9, 9]\n"
        );
        let file = PartsFile::parse(&more).unwrap();
        assert_eq!(file.parts[0].class, "part");
        let splats = Splats {
            // Along the rotated box, across it, and outside all boxes.
            means_m: vec![Vec3::new(1.0, 0.9, 0.0), Vec3::new(1.9, 0.0, 0.0), Vec3::splat(7.0)],
            scales_m: vec![Vec3::ONE; 3],
            rotations: vec![Quat::IDENTITY; 3],
            opacities: vec![1.0; 3],
            sh: vec![0.0; 9],
            ..Splats::default()
        };
        assert_eq!(file.label(&splats), [Some(0), Some(1), None]);
    }

    #[test]
    fn names_the_error() {
        for (text, told) in [
            (GOOD.replace("[2, 0.2, 1]", "[2, 0, 1]"), "is not a valid box"),
            (GOOD.replace("name", "nam"), "nam"),
            (format!("{GOOD}{GOOD}"), "two parts are called 'table'"),
            (GOOD.replace("90", "nan"), "is not finite"),
            (GOOD.replace("table", ""), "give a name"),
        ] {
            let error = format!("{:#}", PartsFile::parse(&text).unwrap_err());
            assert!(error.contains(told), "{text}: {error}");
        }
    }

    #[test]
    fn a_box_encloses_its_points_without_strays() {
        // A board of 2 x 0.1 x 1 m, rotated by 30 degrees, and two strays.
        let turn = DQuat::from_rotation_z(30_f64.to_radians());
        let board = |k: usize| {
            let (across, up) = (k % 21, k / 21);
            let p = DVec3::new(across as f64 / 10.0 - 1.0, 0.1 * (k % 2) as f64, up as f64 / 10.0);
            turn * p + DVec3::new(3.0, 1.0, 0.5)
        };
        let mut points_m: Vec<DVec3> = (0..231).map(board).collect();
        points_m.extend([DVec3::splat(9.0), DVec3::splat(-9.0)]);
        let part = BoxedPart::about("board", "gate", &points_m).unwrap();
        assert_eq!(part.yaw_deg, 30.0);
        assert!((part.size_m - DVec3::new(2.02, 0.12, 1.02)).abs().max_element() < 0.002, "{part}");
        let middle_m = turn * DVec3::new(0.0, 0.05, 0.5) + DVec3::new(3.0, 1.0, 0.5);
        assert!((part.center_m - middle_m).length() < 0.002, "{:?}", part.center_m);
        let error = BoxedPart::about("dot", "gate", &points_m[..3]).unwrap_err().to_string();
        assert!(error.contains("3 splats are too few"), "{error}");
    }

    #[test]
    fn reads_back_stored_parts_and_keeps_names_unique() {
        let folder = tempfile::tempdir().unwrap();
        let path = parts_path(&folder.path().join("room.ply"));
        let part = |name: &str, x_m: f64| BoxedPart {
            name: name.to_owned(),
            class: "gate".to_owned(),
            center_m: DVec3::X * x_m,
            size_m: DVec3::ONE,
            yaw_deg: -3.0,
        };
        let mut file = PartsFile::default();
        for (name, x_m) in [("a \"quoted\" name", 1.0), ("b", 2.0), ("b", 3.0)] {
            file.put(part(name, x_m), &path).unwrap();
        }
        assert!(file.put(part("", 4.0), &path).is_err());
        assert_eq!((PartsFile::read(&path).unwrap(), file.parts.len()), (file.clone(), 2));
        assert_eq!(file.parts[1].center_m.x, 3.0);
    }

    proptest! {
        #[test]
        fn any_text_parses_or_fails_cleanly(text in "(\\[\\[parts\\]\\]\n)?[a-z_=\\[\\]0-9., \"\n-]{0,120}") {
            let _ = PartsFile::parse(&text);
        }
    }
}
