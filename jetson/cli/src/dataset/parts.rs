//! `--parts FILE`: parts of a scene named by boxes, for scenes whose splats nobody knows.
//!
//! ```toml
//! [[parts]]
//! name = "window 1"    # of a stage: then its pose and corners come from the arena
//! class = "gate"
//! center_m = [3.0, 0.4, 1.3]
//! size_m = [0.3, 1.6, 1.6]
//! yaw_deg = 12.0
//! ```
//! A splat belongs to the first box that holds its centre.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_splat::Splats;

/// The whole file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PartsFile {
    pub(super) parts: Vec<BoxedPart>,
}

/// A box that names what is in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BoxedPart {
    pub(super) name: String,
    #[serde(default = "part")]
    pub(super) class: String,
    /// Its middle. [m, world]
    pub(super) center_m: DVec3,
    /// Its sides. [m]
    pub(super) size_m: DVec3,
    /// Turn about z. [deg]
    #[serde(default)]
    pub(super) yaw_deg: f64,
}

fn part() -> String {
    "part".to_owned()
}

impl PartsFile {
    /// Reads a file.
    ///
    /// # Errors
    /// What is wrong with it, by its line or its part.
    pub(super) fn read(path: &Path) -> Result<Self> {
        let context = || format!("cannot use {} as --parts", path.display());
        let text = std::fs::read_to_string(path).with_context(context)?;
        Self::parse(&text).with_context(context)
    }

    fn parse(text: &str) -> Result<Self> {
        let file: Self = vizflyt_toml::parse(text)?;
        for (n, part) in file.parts.iter().enumerate() {
            let BoxedPart { name, class, center_m, size_m, yaw_deg } = part;
            ensure!(
                !name.is_empty() && !class.is_empty(),
                "part {}: give a name and a class",
                n + 1
            );
            let known = file.parts[..n].iter().any(|other| other.name == *name);
            ensure!(!known, "two parts are called '{name}'; give each its own name");
            ensure!(
                size_m.cmpgt(DVec3::ZERO).all() && size_m.is_finite() && center_m.is_finite(),
                "part '{name}': size_m = {size_m} about {center_m} is no box; sides are above 0, in metres"
            );
            ensure!(yaw_deg.is_finite(), "part '{name}': yaw_deg = {yaw_deg} is no angle");
        }
        ensure!(file.parts.len() <= 10_000, "{} parts are more than 10,000", file.parts.len());
        Ok(file)
    }

    /// Returns the index of the part that each splat belongs to.
    pub(super) fn label(&self, splats: &Splats) -> Vec<Option<usize>> {
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
            // Along the turned box, across it, and beside everything.
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
    fn what_is_wrong_is_named() {
        for (text, told) in [
            (GOOD.replace("[2, 0.2, 1]", "[2, 0, 1]"), "is no box"),
            (GOOD.replace("name", "nam"), "nam"),
            (format!("{GOOD}{GOOD}"), "two parts are called 'table'"),
            (GOOD.replace("90", "nan"), "no angle"),
            (GOOD.replace("table", ""), "give a name"),
        ] {
            let error = format!("{:#}", PartsFile::parse(&text).unwrap_err());
            assert!(error.contains(told), "{text}: {error}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_read_or_refused(text in "(\\[\\[parts\\]\\]\n)?[a-z_=\\[\\]0-9., \"\n-]{0,120}") {
            let _ = PartsFile::parse(&text);
        }
    }
}
