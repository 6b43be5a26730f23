//! Poses that exist already.

use std::path::Path;

use anyhow::{Result, bail};
use vizflyt_twin::dataset::colmap;

use super::{Model, Poses};

/// Takes the models of a dataset: `sparse/0`, `sparse/1`, ... of COLMAP.
///
/// # Errors
/// There is none, or it is of another program.
pub(in super::super) fn take_given(dataset: &Path) -> Result<Poses> {
    let mut models = super::models(&dataset.join("sparse"))?;
    if models.is_empty() {
        if dataset.join("transforms.json").is_file() {
            bail!(
                "{} has nerfstudio's poses, without what the pictures saw, by which poses are made metric and checked; \
                 give the folder of COLMAP that `ns-process-data` made beside it (colmap/), or train as it is: \
                 `vizflyt scene train`, then `vizflyt scene align`",
                dataset.display()
            );
        }
        let Some(folder) = colmap::find(dataset) else {
            bail!(
                "{} holds no poses: cameras, images and points3D of COLMAP, in sparse/0 or itself",
                dataset.display()
            );
        };
        let placed = colmap::read(&folder)?.images.len();
        models.push(Model { folder, placed });
    }
    Ok(Poses { tool: format!("given in {}", dataset.display()), models })
}
