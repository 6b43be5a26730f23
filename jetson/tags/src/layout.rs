//! Positions of tags: on a mat or wall in the room, or on a cube on the vehicle.
//!
//! The frame of a tag has its origin in the middle of the tag. Seen upright, x points right, y up, and z out of the
//! printed face towards the reader. The four corners are in the order of [`CORNERS`]: lower left, lower right, upper
//! right, upper left. Detection returns the same order for every rotation of the tag.

use std::collections::HashMap;
use std::path::Path;

use glam::{DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::{Frame, Pose};

use crate::family::TagFamily;
use crate::file::{self, FileError, PoseConfig, check_number, invalid};

/// Frame of a tag: x right, y up, z towards the reader; the origin is its middle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Square {}

impl Frame for Square {
    const NAME: &'static str = "tag";
}

/// Corners of a tag of edge 1 in its own frame, in the order that layouts and detections use: lower
/// left, lower right, upper right, upper left.
pub const CORNERS: [DVec2; 4] =
    [DVec2::new(-0.5, -0.5), DVec2::new(0.5, -0.5), DVec2::new(0.5, 0.5), DVec2::new(-0.5, 0.5)];

/// Frame of a layout's tags.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LayoutFrame {
    /// The room: tags on a mat on the floor, or on a wall.
    World,
    /// The vehicle: tags on its cube.
    Body,
}

/// Tags with their poses.
///
/// ```
/// use glam::DVec3;
/// let text = r#"
/// frame = "world"
///
/// [[tags]]
/// family = "tag36h11"
/// id = 7
/// size_m = 0.16
/// position_m = [1.0, 2.0, 0.0]
/// rotation_xyzw = [0.0, 0.0, 0.0, 1.0]
/// "#;
/// let mat = vizflyt_tags::layout::TagLayout::parse(text).unwrap();
/// // The tag lies on the floor, with its upper edge to the north, and is read from above.
/// let tag = mat.find(mat.tags[0].family, 7).unwrap();
/// assert_eq!(tag.corners_m()[0], DVec3::new(0.92, 1.92, 0.0));
/// assert_eq!(tag.normal(), DVec3::Z);
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TagLayout {
    /// Frame of the tags' poses.
    pub frame: LayoutFrame,
    /// The tags. Each pair of family and id is unique.
    pub tags: Vec<Tag>,
}

/// One tag of a layout.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tag {
    #[serde(default)]
    pub family: TagFamily,
    /// Number in the family.
    pub id: u32,
    /// Edge of the black square. If the family has data outside its border: edge of the square whose corners are
    /// detected. [m]
    pub size_m: f64,
    /// Middle of the tag. [m, the layout's frame]
    pub position_m: DVec3,
    /// Rotation from the tag's axes (x right, y up, z towards the reader) to those of the layout's frame; unit
    /// quaternion, Hamilton, xyzw.
    pub rotation_xyzw: DQuat,
}

impl Tag {
    /// Returns the tag at a pose in the layout's frame.
    pub fn new<F: Frame>(
        family: TagFamily,
        id: u32,
        size_m: f64,
        frame_from_tag: Pose<F, Square>,
    ) -> Self {
        let (position_m, rotation_xyzw) = (frame_from_tag.translation_m, frame_from_tag.rotation);
        Self { family, id, size_m, position_m, rotation_xyzw }
    }

    /// Returns the pose of the tag. The caller chooses `F`, which must match [`TagLayout::frame`].
    pub fn frame_from_tag<F: Frame>(&self) -> Pose<F, Square> {
        Pose::new(self.position_m, self.rotation_xyzw)
    }

    /// Returns the corners, in the order of [`CORNERS`]. [m, the layout's frame]
    pub fn corners_m(&self) -> [DVec3; 4] {
        CORNERS.map(|c| self.position_m + self.rotation_xyzw * (c * self.size_m).extend(0.0))
    }

    /// Returns the direction in which the printed face points. [the layout's frame]
    pub fn normal(&self) -> DVec3 {
        self.rotation_xyzw * DVec3::Z
    }
}

impl TagLayout {
    /// Maximum number of tags. A hall of 30 x 30 m with one tag per metre has 900.
    pub const MAX_TAGS: usize = 4096;

    /// Parses a layout from TOML and normalizes the quaternions.
    ///
    /// # Errors
    /// [`FileError::Toml`] if the text does not match the format, [`FileError::Invalid`] for a value out of range.
    pub fn parse(text: &str) -> Result<Self, FileError> {
        let mut layout: Self = vizflyt_toml::parse(text)?;
        layout.validate()?;
        for tag in &mut layout.tags {
            // Unit quaternions are not normalized again, so that they stay identical bit for bit.
            if (tag.rotation_xyzw.length_squared() - 1.0).abs() > 1e-12 {
                tag.rotation_xyzw = tag.rotation_xyzw.normalize();
            }
        }
        Ok(layout)
    }

    /// Reads a layout file.
    ///
    /// # Errors
    /// As [`Self::parse`], and [`FileError::Io`]; the error contains the path.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        file::read(path, Self::parse)
    }

    /// Returns the layout as TOML.
    ///
    /// # Errors
    /// [`FileError::Unwritable`], if a number is NaN.
    pub fn to_toml(&self) -> Result<String, FileError> {
        Ok(toml::to_string(self)?)
    }

    /// Writes a layout file.
    ///
    /// # Errors
    /// [`FileError::Io`]; the error contains the path.
    pub fn write(&self, path: &Path) -> Result<(), FileError> {
        file::write(path, &self.to_toml()?)
    }

    /// Returns the tag of this family and id.
    pub fn find(&self, family: TagFamily, id: u32) -> Option<&Tag> {
        self.tags.iter().find(|tag| tag.family == family && tag.id == id)
    }

    /// Checks all values and rejects duplicate tags.
    ///
    /// # Errors
    /// [`FileError::Invalid`] for the first value out of range.
    pub fn validate(&self) -> Result<(), FileError> {
        if !(1..=Self::MAX_TAGS).contains(&self.tags.len()) {
            let advice = format!("give 1 to {} [[tags]]", Self::MAX_TAGS);
            return Err(invalid("tags", format!("{} of them", self.tags.len()), advice));
        }
        let mut sizes = HashMap::new();
        let mut taken = HashMap::new();
        for (index, tag) in self.tags.iter().enumerate() {
            let key = |field: &str| format!("tags[{index}].{field}");
            let ids = *sizes.entry(tag.family).or_insert_with(|| tag.family.ids());
            if tag.id >= ids {
                let advice = format!("{} has ids 0 to {}", tag.family, ids - 1);
                return Err(invalid(key("id"), tag.id, advice));
            }
            if let Some(first) = taken.insert((tag.family, tag.id), index) {
                let advice = format!("tags[{first}] is the same tag; print each once");
                return Err(invalid(key("id"), tag.id, advice));
            }
            check_number(&key("size_m"), tag.size_m, "m", SIZES_M)?;
            PoseConfig { position_m: tag.position_m, rotation_xyzw: tag.rotation_xyzw }
                .check(key)?;
        }
        Ok(())
    }
}

/// Accepted edges of tags: from macro lens to poster. [m]
const SIZES_M: std::ops::RangeInclusive<f64> = 0.002..=5.0;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const MAT: &str = "frame = \"body\"\n[[tags]]\nfamily = \"tag25h9\"\nid = 3\nsize_m = 0.1\n\
                       position_m = [0.0, 0.0, 0.05]\nrotation_xyzw = [0.0, 0.0, 0.0, 1.0]\n";

    fn check_refused(from: &str, to: &str, parts: &[&str]) {
        let text = MAT.replace(from, to);
        assert_ne!(text, MAT, "{from} is not in the layout");
        let error = TagLayout::parse(&text).expect_err(&text).to_string();
        for part in parts {
            assert!(error.contains(part), "{error:?} lacks {part:?}");
        }
    }

    #[test]
    fn rejects_invalid_values_with_their_key() {
        check_refused("id = 3", "id = 35", &["tags[0].id = 35", "tag25h9 has ids 0 to 34"]);
        check_refused("0.1\n", "0.0\n", &["tags[0].size_m = 0", "0.002 to 5 m"]);
        check_refused("0.1\n", "nan\n", &["tags[0].size_m = NaN"]);
        check_refused("0.05]", "inf]", &["tags[0].position_m", "finite"]);
        check_refused("0.0, 1.0]", "0.0, 0.0]", &["tags[0].rotation_xyzw", "length 1"]);
        check_refused("\"body\"", "\"ned\"", &["ned", "world"]);
        check_refused("id = 3", "id = 3\nheight = 2", &["height"]);
        check_refused("tag25h9", "tag36h10", &["tag36h10", "tag36h11"]);
        let twice = format!("{MAT}{}", &MAT[MAT.find("[[").unwrap()..]);
        let error = TagLayout::parse(&twice).unwrap_err().to_string();
        assert!(error.contains("tags[1].id = 3") && error.contains("tags[0]"), "{error}");
        let none = TagLayout::parse("frame = \"world\"\ntags = []").unwrap_err().to_string();
        assert!(none.contains("1 to 4096"), "{none}");
    }

    #[test]
    fn places_corners_of_a_tag_on_the_cubes_front() {
        // z of the tag is the vehicle's x; x of the tag is the vehicle's y.
        let axes = glam::DMat3::from_cols(DVec3::Y, DVec3::Z, DVec3::X);
        let body_from_tag: Pose<vizflyt_protocol::geometry::Body, Square> =
            Pose::new(DVec3::X * 0.1, DQuat::from_mat3(&axes));
        let tag = Tag::new(TagFamily::Tag36h11, 0, 0.2, body_from_tag);
        assert!((tag.normal() - DVec3::X).length() < 1e-12);
        let [low_left, low_right, up_right, _] = tag.corners_m();
        assert!((low_left - DVec3::new(0.1, -0.1, -0.1)).length() < 1e-12);
        assert!((low_right - DVec3::new(0.1, 0.1, -0.1)).length() < 1e-12);
        assert!((up_right - DVec3::new(0.1, 0.1, 0.1)).length() < 1e-12);
    }

    proptest! {
        #[test]
        fn layout_survives_a_round_trip_through_toml(
            ids in prop::collection::hash_set(0u32..587, 1..9),
            size_m in 0.01..1.0f64,
            p in prop::array::uniform3(-20.0..20.0f64),
            angle in -3.0..3.0f64,
        ) {
            let rotation = DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), angle);
            let tags = ids.into_iter().map(|id| Tag {
                family: TagFamily::Tag36h11, id, size_m, position_m: p.into(), rotation_xyzw: rotation,
            }).collect();
            let layout = TagLayout { frame: LayoutFrame::World, tags };
            let again = TagLayout::parse(&layout.to_toml().unwrap()).unwrap();
            prop_assert_eq!(again, layout);
        }
    }
}
