//! Classes of pixels and things: a fixed list, followed by the classes of a parts file.

use anyhow::{Result, ensure};
use vizflyt_scenes::parts::PartClass;

/// All classes of a data set. The number of a class is its index; 0 means that (almost) nothing was hit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Classes {
    names: Vec<String>,
}

/// Splats without a named part.
pub(super) const SCENE: u8 = 1;
pub(super) const GATE: u8 = 2;
pub(super) const VEHICLE: u8 = 3;
pub(super) const MOVING: u8 = 4;
pub(super) const DISTRACTOR: u8 = 5;

/// Fixed classes in order of their numbers.
const FIXED: [&str; 15] = [
    "nothing",
    "scene",
    "gate",
    "vehicle",
    "moving",
    "distractor",
    "stand",
    "wall",
    "pillar",
    "room",
    "ground",
    "tree",
    "plant",
    "backdrop",
    "part",
];
/// Classes of surroundings, which have no instances.
const SURROUNDINGS: [&str; 7] = ["nothing", "scene", "room", "ground", "tree", "plant", "backdrop"];

impl Classes {
    /// Returns the fixed classes and the given ones.
    ///
    /// # Errors
    /// There are more than 256 classes.
    pub(super) fn with<'a>(added: impl Iterator<Item = &'a str>) -> Result<Self> {
        let mut names: Vec<String> = FIXED.map(str::to_owned).into();
        for name in added {
            if !names.iter().any(|known| known == name) {
                names.push(name.to_owned());
            }
        }
        ensure!(names.len() <= 256, "{} classes, but the 8 bits of a pixel allow 256", names.len());
        Ok(Self { names })
    }

    pub(super) fn names(&self) -> &[String] {
        &self.names
    }

    /// Returns the number of a class.
    pub(super) fn number(&self, name: &str) -> Option<u8> {
        let at = self.names.iter().position(|known| known == name)?;
        u8::try_from(at).ok()
    }

    pub(super) fn of_part(&self, class: PartClass) -> u8 {
        self.number(class.name()).unwrap_or(SCENE)
    }

    pub(super) fn name(&self, number: u8) -> &str {
        self.names.get(usize::from(number)).map_or("nothing", String::as_str)
    }

    /// Whether a class has instances, which surroundings do not.
    pub(super) fn is_thing(&self, number: u8) -> bool {
        !SURROUNDINGS.contains(&self.name(number))
    }

    /// Returns the names of all classes of things.
    pub(super) fn things(&self) -> impl Iterator<Item = &str> {
        self.names.iter().map(String::as_str).filter(|name| !SURROUNDINGS.contains(name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_indices_in_the_list() {
        let classes = Classes::with(["table", "gate"].into_iter()).unwrap();
        for (number, name) in [(GATE, "gate"), (VEHICLE, "vehicle"), (MOVING, "moving")] {
            assert_eq!((classes.number(name), classes.name(number)), (Some(number), name));
        }
        assert_eq!(classes.number("distractor"), Some(DISTRACTOR));
        assert_eq!((classes.number("scene"), classes.number("nothing")), (Some(SCENE), Some(0)));
        assert_eq!(classes.names().len(), FIXED.len() + 1);
        assert!(classes.is_thing(classes.number("table").unwrap()) && !classes.is_thing(SCENE));
        let all = [
            PartClass::Gate,
            PartClass::Stand,
            PartClass::Wall,
            PartClass::Pillar,
            PartClass::Room,
            PartClass::Ground,
            PartClass::Tree,
            PartClass::Plant,
            PartClass::Backdrop,
        ];
        assert!(all.into_iter().all(|class| classes.number(class.name()).is_some()));
        let many: Vec<String> = (0..300).map(|n| n.to_string()).collect();
        let error = Classes::with(many.iter().map(String::as_str)).unwrap_err().to_string();
        assert!(error.contains("315 classes"), "{error}");
    }
}
