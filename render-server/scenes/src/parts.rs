//! What a generated scene is made of: which splats are of which gate, wall or tree.
//!
//! Painters fill a canvas one thing after the other, so that a thing is a range of splats: exact, where boxes around
//! things would have to guess. Masks of `vizflyt dataset` are made from them.

use core::ops::Range;

use crate::canvas::Canvas;

/// One thing that stands still, or one kind of ground.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ScenePart {
    /// `window 1`; of a gate the name of its stage.
    pub name: String,
    /// What it is.
    pub class: PartClass,
    /// Its splats, by their place in [`Generated::splats`](crate::Generated::splats).
    pub splats: Range<usize>,
}

/// What a part is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PartClass {
    /// The frame of a racing window, without its stand.
    Gate,
    /// Legs and feet of a gate, and the motor of a hand.
    Stand,
    /// A wall that is flown through or around.
    Wall,
    /// A pillar.
    Pillar,
    /// Shell and furniture of the hall.
    Room,
    /// The ground of the forest.
    Ground,
    /// Trunks, branches and logs.
    Tree,
    /// Leaves, ferns and grass.
    Plant,
    /// What is far away.
    Backdrop,
}

impl PartClass {
    /// Returns its name: `gate`.
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

/// Notes what painters add to a canvas.
#[derive(Debug, Default)]
pub(crate) struct Parts {
    parts: Vec<ScenePart>,
    painted: usize,
}

impl Parts {
    /// Takes what was painted since the last call for a part; nothing painted is no part.
    pub(crate) fn add(&mut self, canvas: &Canvas, class: PartClass, name: &str) {
        let splats = self.painted..canvas.len();
        self.painted = splats.end;
        if !splats.is_empty() {
            self.parts.push(ScenePart { name: name.to_owned(), class, splats });
        }
    }

    /// Returns them.
    pub(crate) fn finish(self) -> Vec<ScenePart> {
        self.parts
    }
}
