//! `[scene]`: the splats of the room, and their placement in the world.
//!
//! ```toml
//! [scene]
//! file = "kitchen.ply"            # relative to the folder of arena.toml
//! up = "-y"                       # the file's axis that points up; or rotation = [x, y, z, w]
//! yaw_deg = 90.0                  # applied second: turn about the world's z, counter-clockwise
//! metres_per_unit = 0.176
//! origin = [0.3, -1.2, 1.4]       # position of the file's origin [m, world]
//! crop = { min_m = [-4, -3, -0.5], max_m = [4, 3, 3] }    # splats outside are removed [m, world]
//! antialiased = true              # trained with mip-splatting; overrides the file
//! ```
//! `scene = "kitchen.ply"` is the short form for a scene in world coordinates, such as a generated one.

use std::fmt;
use std::str::FromStr;

use glam::{DMat3, DQuat, DVec3};
use serde::de::value::{MapAccessDeserializer, StrDeserializer};
use serde::de::{Error, IntoDeserializer, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::validate::{ConfigError, check_number, check_position, invalid};
use super::{ArenaConfig, Geofence};

/// `[scene]`: a file of splats, and its placement in the world.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneConfig {
    /// Splat scene, relative to the folder of `arena.toml`.
    pub file: String,
    /// Axis of the file that points up; leave it out with `rotation`, or if the file needs no turn.
    pub up: Option<Up>,
    /// Turn about the world's z, counter-clockwise, after `up`. [deg]
    pub yaw_deg: f64,
    /// Rotation from the scene's axes to the world's, in place of `up` and `yaw_deg`: a quaternion x, y, z, w.
    pub rotation: Option<[f64; 4]>,
    /// Length of one unit of the file. [m]
    pub metres_per_unit: f64,
    /// Position of the file's origin. [m, world]
    pub origin_m: DVec3,
    /// Box of splats to keep, by their centres; without it, all are kept. [m, world]
    pub crop: Option<Geofence>,
    /// Whether the scene was trained with anti-aliasing (mip-splatting); default: as stated in the file.
    pub antialiased: Option<bool>,
}

impl SceneConfig {
    /// Returns the config of a file in world coordinates.
    pub fn in_world(file: impl Into<String>) -> Self {
        Self {
            file: file.into(),
            up: None,
            yaw_deg: 0.0,
            rotation: None,
            metres_per_unit: 1.0,
            origin_m: DVec3::ZERO,
            crop: None,
            antialiased: None,
        }
    }

    /// Returns the rotation from the file's axes to the world's.
    pub fn rotation(&self) -> DQuat {
        if let Some(rotation) = self.rotation {
            return DQuat::from_array(rotation).normalize();
        }
        let upright = self.up.unwrap_or(Up::Z).world_from_scene();
        if self.yaw_deg == 0.0 {
            return upright;
        }
        DQuat::from_rotation_z(self.yaw_deg.to_radians()) * upright
    }

    /// Whether the scene is in world coordinates: no rotation, scale, shift or crop.
    pub fn is_in_world(&self) -> bool {
        *self == Self::in_world(self.file.as_str())
    }

    fn check(&self) -> Result<(), ConfigError> {
        if self.file.trim().is_empty() {
            let key = if self.is_in_world() { "scene" } else { "scene.file" };
            return Err(invalid(key, "\"\"", "give the scene file, relative to this file"));
        }
        check_number("scene.metres_per_unit", self.metres_per_unit, "m", METRES_PER_UNIT)?;
        check_number("scene.yaw_deg", self.yaw_deg, "degrees", -360.0..=360.0)?;
        check_position("scene.origin", self.origin_m)?;
        if let Some(rotation) = self.rotation {
            let advice = if self.up.is_some() || self.yaw_deg != 0.0 {
                "give either rotation, or up and yaw_deg"
            } else if !((DQuat::from_array(rotation).length() - 1.0).abs() < 1e-3) {
                "give a unit quaternion as [x, y, z, w]; the identity is [0, 0, 0, 1]"
            } else {
                ""
            };
            if !advice.is_empty() {
                return Err(invalid("scene.rotation", format!("{rotation:?}"), advice));
            }
        }
        let Some(crop) = self.crop else { return Ok(()) };
        check_position("scene.crop.min_m", crop.min_m)?;
        check_position("scene.crop.max_m", crop.max_m)?;
        if !(crop.max_m - crop.min_m).cmpgt(DVec3::ZERO).all() {
            let advice = format!("must exceed scene.crop.min_m = {} on each axis", crop.min_m);
            return Err(invalid("scene.crop.max_m", crop.max_m, advice));
        }
        Ok(())
    }
}

impl From<&str> for SceneConfig {
    /// Same as [`SceneConfig::in_world`].
    fn from(file: &str) -> Self {
        Self::in_world(file)
    }
}

impl ArenaConfig {
    pub(super) fn check_scene(&self) -> Result<(), ConfigError> {
        self.scene.check()
    }
}

/// Allowed metres per unit: from a grain of sand to a campus.
pub const METRES_PER_UNIT: std::ops::RangeInclusive<f64> = 1e-4..=1e4;

/// Axis of a scene's file that points up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Up {
    /// `x`: the file's x axis.
    X,
    /// `-x`: opposite to the file's x axis.
    NegX,
    /// `y`: the file's y axis, as in exports of game engines.
    Y,
    /// `-y`: opposite to the file's y axis, as in COLMAP if the first camera is upright (y down, z forward).
    #[default]
    NegY,
    /// `z`: the file's z axis, as in the world and in exports of nerfstudio.
    Z,
    /// `-z`: opposite to the file's z axis.
    NegZ,
}

impl Up {
    /// Every axis.
    pub const ALL: [Self; 6] = [Self::X, Self::NegX, Self::Y, Self::NegY, Self::Z, Self::NegZ];

    /// Returns the text form.
    pub fn name(self) -> &'static str {
        match self {
            Self::X => "x",
            Self::NegX => "-x",
            Self::Y => "y",
            Self::NegY => "-y",
            Self::Z => "z",
            Self::NegZ => "-z",
        }
    }

    /// Returns the rotation that takes this axis to the world's +z. For y-up and y-down scenes, it also takes
    /// the usual forward axis to the world's +x.
    pub fn world_from_scene(self) -> DQuat {
        // Rows: the world's axes in scene axes.
        let rows = match self {
            Self::Z => [DVec3::X, DVec3::Y, DVec3::Z],
            Self::NegZ => [DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z],
            // Camera axes: x right, y down, z forward.
            Self::NegY => [DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y],
            // Graphics axes: x right, y up, z backward.
            Self::Y => [DVec3::NEG_Z, DVec3::NEG_X, DVec3::Y],
            Self::X => [DVec3::Y, DVec3::Z, DVec3::X],
            Self::NegX => [DVec3::Z, DVec3::Y, DVec3::NEG_X],
        };
        DQuat::from_mat3(&DMat3::from_cols(rows[0], rows[1], rows[2]).transpose())
    }
}

impl fmt::Display for Up {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Error for an unknown axis name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown axis '{0}'; give the axis that points up in the file: x, -x, y, -y, z or -z")]
pub struct UnknownAxis(String);

impl FromStr for Up {
    type Err = UnknownAxis;

    /// Parses `-y`; also accepts `y-` and `+y`.
    fn from_str(text: &str) -> Result<Self, UnknownAxis> {
        let lower = text.trim().to_ascii_lowercase();
        let name = match lower.strip_suffix('-') {
            Some(axis) => format!("-{axis}"),
            None => lower.trim_start_matches('+').trim_end_matches('+').to_owned(),
        };
        let found = Self::ALL.into_iter().find(|up| up.name() == name);
        found.ok_or_else(|| UnknownAxis(text.to_owned()))
    }
}

impl Serialize for Up {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Up {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(D::Error::custom)
    }
}

/// `[scene]` as it is in the file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    file: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    up: Option<Up>,
    #[serde(default, skip_serializing_if = "is_zero")]
    yaw_deg: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    rotation: Option<[f64; 4]>,
    #[serde(default = "one")]
    metres_per_unit: f64,
    /// Position of the file's origin. [m, world]
    #[serde(default)]
    origin: DVec3,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    crop: Option<Geofence>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    antialiased: Option<bool>,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

fn one() -> f64 {
    1.0
}

impl Serialize for SceneConfig {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if self.is_in_world() {
            return serializer.serialize_str(&self.file);
        }
        let Self { file, up, yaw_deg, rotation, metres_per_unit, origin_m, crop, antialiased } =
            self.clone();
        let origin = origin_m;
        Table { file, up, yaw_deg, rotation, metres_per_unit, origin, crop, antialiased }
            .serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for SceneConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = SceneConfig;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a scene file's name, or a table [scene] with `file`")
            }

            fn visit_str<E: Error>(self, file: &str) -> Result<SceneConfig, E> {
                let file: StrDeserializer<'_, E> = file.into_deserializer();
                Ok(SceneConfig::in_world(String::deserialize(file)?))
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<SceneConfig, A::Error> {
                let table = Table::deserialize(MapAccessDeserializer::new(map))?;
                let Table {
                    file,
                    up,
                    yaw_deg,
                    rotation,
                    metres_per_unit,
                    origin: origin_m,
                    crop,
                    antialiased,
                } = table;
                Ok(SceneConfig {
                    file,
                    up,
                    yaw_deg,
                    rotation,
                    metres_per_unit,
                    origin_m,
                    crop,
                    antialiased,
                })
            }
        }
        deserializer.deserialize_any(Either)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct File {
        scene: SceneConfig,
        after: u8,
    }

    fn parse(scene: &str) -> Result<File, String> {
        vizflyt_toml::parse(&format!("after = 1\n{scene}")).map_err(|error| error.to_string())
    }

    fn scene(text: &str) -> SceneConfig {
        parse(text).unwrap().scene
    }

    #[test]
    fn both_forms_round_trip() {
        let short = scene("scene = \"a.ply\"");
        assert_eq!(short, SceneConfig::in_world("a.ply"));
        assert!(short.is_in_world() && short.rotation() == DQuat::IDENTITY);
        assert_eq!(scene("[scene]\nfile = \"a.ply\""), short);
        assert_eq!(
            toml::to_string(&File { scene: short, after: 1 }).unwrap(),
            "scene = \"a.ply\"\nafter = 1\n"
        );
        let long = "[scene]\nfile = \"a.ply\"\nup = \"-y\"\nyaw_deg = 30\nmetres_per_unit = 0.2\n\
                    origin = [1, 2, 3]\ncrop = { min_m = [0, 0, 0], max_m = [4, 5, 6] }\n\
                    antialiased = false";
        let file = parse(long).unwrap();
        file.scene.check().unwrap();
        assert!(!file.scene.is_in_world());
        let text = toml::to_string(&file).unwrap();
        assert_eq!(vizflyt_toml::parse::<File>(&text).unwrap(), file, "{text}");
    }

    #[test]
    fn errors_name_the_line_and_the_key() {
        let refused = |text: &str, expected: &[&str]| {
            let error = parse(text).unwrap_err();
            for expected in expected {
                assert!(error.contains(expected), "'{error}' lacks '{expected}'");
            }
        };
        refused("[scene]\nfile = \"a\"\nscale = 2", &["line 4", "scale"]);
        refused("[scene]\nup = \"z\"", &["file"]);
        refused("[scene]\nfile = \"a\"\nup = \"w\"", &["line 4", "unknown axis 'w'", "-z"]);
        refused(
            "[scene]\nfile = \"a\"\nantialiased = \"on\"",
            &["line 4", "antialiased", "boolean"],
        );
        refused("scene = \"a\"\nantialiased = true", &["antialiased"]);
        refused("scene = 3", &["line 2", "a scene file's name, or a table"]);
        let invalid = |text: &str, expected: &str| {
            let error = scene(&format!("[scene]\nfile = \"a\"\n{text}")).check().unwrap_err();
            assert!(error.to_string().contains(expected), "'{error}' lacks '{expected}'");
        };
        invalid("metres_per_unit = 0", "scene.metres_per_unit = 0: give a number from");
        invalid("metres_per_unit = nan", "scene.metres_per_unit = NaN");
        invalid("rotation = [0, 0, 0, 0]", "a unit quaternion");
        invalid("rotation = [0, 0, 0, 1]\nup = \"z\"", "give either rotation, or up");
        invalid("origin = [0, 0, inf]", "scene.origin = ");
        invalid("crop = { min_m = [0, 0, 0], max_m = [1, 1, 0] }", "scene.crop.max_m = ");
    }

    #[test]
    fn rotates_up_axis_to_z_and_forward_axis_to_x() {
        let axes = [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::Z, DVec3::NEG_Z];
        for (up, axis) in Up::ALL.into_iter().zip(axes) {
            let turned = up.world_from_scene() * axis;
            assert!((turned - DVec3::Z).length() < 1e-12, "{up:?}: {turned}");
            assert_eq!(up.name().parse(), Ok(up));
        }
        assert!((Up::NegY.world_from_scene() * DVec3::Z - DVec3::X).length() < 1e-12);
        assert!((Up::Y.world_from_scene() * DVec3::NEG_Z - DVec3::X).length() < 1e-12);
        assert_eq!(("y-".parse(), " +Z ".parse()), (Ok(Up::NegY), Ok(Up::Z)));
        for wrong in ["", "-", "w", "-y-", "xy", "--z"] {
            assert!(wrong.parse::<Up>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn yaw_of_90_degrees_takes_x_to_y() {
        let about_z = |text: &str| scene(&format!("[scene]\nfile = \"a\"\n{text}")).rotation();
        let half = std::f64::consts::FRAC_1_SQRT_2;
        for text in ["yaw_deg = 90", &format!("rotation = [0, 0, {half}, {half}]")] {
            assert!((about_z(text) * DVec3::X - DVec3::Y).length() < 1e-9, "{text}");
        }
        assert!((about_z("up = \"-y\"\nyaw_deg = 90") * DVec3::Z - DVec3::Y).length() < 1e-9);
    }
}
