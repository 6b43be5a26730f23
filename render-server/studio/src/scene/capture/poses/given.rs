//! Existing poses of `--poses`.

use std::path::Path;

use anyhow::{Result, bail};
use vizflyt_twin::dataset::colmap;

use super::{Model, Poses};

/// Reads the models of a dataset: `sparse/0`, `sparse/1`, ... of COLMAP.
///
/// # Errors
/// The dataset has no model, or is not of COLMAP.
pub(in super::super) fn take_given(dataset: &Path) -> Result<Poses> {
    let mut models = super::models(&dataset.join("sparse"))?;
    if models.is_empty() {
        if dataset.join("transforms.json").is_file() {
            bail!(
                "{} has nerfstudio's poses, without the points and observations that scale and verdict need; \
                 give the folder of COLMAP that `ns-process-data` wrote next to it (colmap/), or train directly: \
                 `vizflyt scene train`, then `vizflyt scene align`",
                dataset.display()
            );
        }
        let Some(folder) = colmap::find(dataset) else {
            bail!(
                "{} contains no poses: expected cameras, images and points3D of COLMAP, in sparse/0 or directly",
                dataset.display()
            );
        };
        let placed = colmap::read(&folder)?.images.len();
        models.push(Model { folder, placed });
    }
    Ok(Poses { tool: format!("given in {}", dataset.display()), models })
}
