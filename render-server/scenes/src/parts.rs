//! Parts of a generated scene: the splats of each gate, wall or tree.
//!
//! Things are painted one after the other, so that each is an exact range of splats; boxes around things would only be
//! approximate. `vizflyt dataset` derives its masks from them.

use core::ops::Range;

use crate::canvas::Canvas;

/// Static thing, or kind of ground.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ScenePart {
    /// Name, such as `window 1`; for a gate, that of its stage.
    pub name: String,
    pub class: PartClass,
    /// Range of its splats in [`Generated::splats`](crate::Generated::splats).
    pub splats: Range<usize>,
}

/// Class of a part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PartClass {
    /// Frame of a racing window, without its stand.
    Gate,
    /// Legs and feet of a gate, or the motor of a clock hand.
    Stand,
    /// Wall to fly through or around.
    Wall,
    /// A pillar.
    Pillar,
    /// Shell and furniture of the hall.
    Room,
    /// Ground of the forest.
    Ground,
    /// Trunks, branches and logs.
    Tree,
    /// Leaves, ferns and grass.
    Plant,
    /// Distant surroundings.
    Backdrop,
}

impl PartClass {
    /// Returns the name of the class, such as `gate`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Gate => "gate",
            Self::Stand => "stand",
            Self::Wall => "wall",
            Self::Pillar => "pillar",
            Self::Room => "room",
            Self::Ground => "ground",
            Self::Tree => "tree",
            Self::Plant => "plant",
            Self::Backdrop => "backdrop",
        }
    }
}

/// Recorder of parts while a canvas is painted.
#[derive(Debug, Default)]
pub(crate) struct Parts {
    parts: Vec<ScenePart>,
    painted: usize,
}

impl Parts {
    /// Adds a part with all splats painted since the last call; adds nothing if there are none.
    pub(crate) fn add(&mut self, canvas: &Canvas, class: PartClass, name: &str) {
        let splats = self.painted..canvas.len();
        self.painted = splats.end;
        if !splats.is_empty() {
            self.parts.push(ScenePart { name: name.to_owned(), class, splats });
        }
    }

    pub(crate) fn finish(self) -> Vec<ScenePart> {
        self.parts
    }
}
