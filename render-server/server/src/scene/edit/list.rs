//! `NAME.edits.toml`: the edits of a scene, in order.
//!
//! ```toml
//! [scene]
//! file = "room.ply"
//! sha256 = "9f86d081..."
//! splats = 124495
//!
//! [[steps]]
//! taken = 8110
//!
//! [steps.edit.floaters]
//! cell = 0.25
//! least = 50
//! ```
//! Lengths are in the unit that the scene has when it is the step's turn.

use serde::{Deserialize, Serialize};
use vizflyt_splat::edit::{EditStep, InvalidStep};
use vizflyt_toml::TomlErrors;

/// What is in the file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EditList {
    /// What is edited.
    pub scene: OriginalScene,
    /// In order.
    #[serde(default)]
    pub steps: Vec<DoneStep>,
}

/// The scene that a list is about.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OriginalScene {
    /// Its file's name, in the folder of the list.
    pub file: String,
    /// Of the file's bytes, in hexadecimal.
    pub sha256: String,
    /// How many splats it has.
    pub splats: usize,
}

/// A step, and what it did.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DoneStep {
    /// How many splats it took away.
    pub taken: usize,
    /// The step.
    pub edit: EditStep,
}

/// Why a text is no list.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EditListError {
    /// Lines, keys or types.
    #[error(transparent)]
    Toml(#[from] TomlErrors),
    /// A step's numbers.
    #[error("step {number}: {cause}")]
    Step {
        /// From 1.
        number: usize,
        /// What is wrong.
        cause: InvalidStep,
    },
    /// No hash.
    #[error("scene.sha256 = \"{0}\": 64 hexadecimal digits are wanted")]
    Hash(String),
    /// More than anybody edits.
    #[error(
        "it is too long: at most {} bytes and {} steps are read",
        EditList::MAX_BYTES,
        EditList::MAX_STEPS
    )]
    TooLong,
}

impl EditList {
    /// The longest file: lassos of hundred corners, thousand of them.
    pub const MAX_BYTES: u64 = 16 << 20;
    /// The most steps.
    pub const MAX_STEPS: usize = 1000;

    /// Returns the list of a scene that nobody has edited.
    pub fn new(file: String, sha256: String, splats: usize) -> Self {
        Self { scene: OriginalScene { file, sha256, splats }, steps: Vec::new() }
    }

    /// Reads a file's text.
    ///
    /// # Errors
    /// What is wrong with it, and where.
    pub fn parse(text: &str) -> Result<Self, EditListError> {
        if text.len() as u64 > Self::MAX_BYTES {
            return Err(EditListError::TooLong);
        }
        let list: Self = vizflyt_toml::parse(text)?;
        if list.steps.len() > Self::MAX_STEPS {
            return Err(EditListError::TooLong);
        }
        let hash = &list.scene.sha256;
        if hash.len() != 64 || !hash.bytes().all(|byte| byte.is_ascii_hexdigit()) {
            return Err(EditListError::Hash(hash.chars().take(80).collect()));
        }
        for (index, done) in list.steps.iter().enumerate() {
            let number = index + 1;
            done.edit.check().map_err(|cause| EditListError::Step { number, cause })?;
        }
        Ok(list)
    }

    /// Returns the file's text.
    pub fn to_toml(&self) -> String {
        // A comment holds no control characters; a name may.
        let file = self.scene.file.replace(char::is_control, " ");
        let head =
            format!("# Edits of {file}: vizflyt scene edit {file} --list, --undo, --apply\n\n");
        // Strings, finite numbers and tables of a known shape: TOML holds them all.
        head + &toml::to_string(self).unwrap_or_default()
    }
}
