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
//! Lengths are in the unit of the scene at the time of the step.

use serde::{Deserialize, Serialize};
use vizflyt_splat::edit::{EditStep, InvalidStep};
use vizflyt_toml::TomlErrors;

/// Contents of the file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EditList {
    /// Edited scene.
    pub scene: OriginalScene,
    /// Steps in order.
    #[serde(default)]
    pub steps: Vec<DoneStep>,
}

/// Scene of a list of edits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OriginalScene {
    /// Name of its file, in the folder of the list.
    pub file: String,
    /// SHA-256 of the file, in hexadecimal.
    pub sha256: String,
    /// Number of its splats.
    pub splats: usize,
}

/// Step with its effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DoneStep {
    /// Number of splats removed.
    pub taken: usize,
    pub edit: EditStep,
}

/// Why a text is not a valid list.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EditListError {
    /// Invalid lines, keys or types.
    #[error(transparent)]
    Toml(#[from] TomlErrors),
    /// Invalid numbers of a step.
    #[error("step {number}: {cause}")]
    Step {
        /// Number of the step, from 1.
        number: usize,
        cause: InvalidStep,
    },
    /// Invalid hash.
    #[error("scene.sha256 = \"{0}\": give 64 hexadecimal digits")]
    Hash(String),
    /// Limits exceeded.
    #[error(
        "it is too long: at most {} bytes and {} steps are read",
        EditList::MAX_BYTES,
        EditList::MAX_STEPS
    )]
    TooLong,
}

impl EditList {
    /// Maximum size of the file: a thousand lassos of a hundred corners.
    pub const MAX_BYTES: u64 = 16 << 20;
    /// Maximum number of steps.
    pub const MAX_STEPS: usize = 1000;

    /// Creates the empty list of a scene.
    pub fn new(file: String, sha256: String, splats: usize) -> Self {
        Self { scene: OriginalScene { file, sha256, splats }, steps: Vec::new() }
    }

    /// Parses a list.
    ///
    /// # Errors
    /// The error and its position.
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
        // A comment must not contain control characters, but a name may.
        let file = self.scene.file.replace(char::is_control, " ");
        let head =
            format!("# Edits of {file}: vizflyt scene edit {file} --list, --undo, --apply\n\n");
        // Strings, finite numbers and tables of a known shape are always valid TOML.
        head + &toml::to_string(self).unwrap_or_default()
    }
}
