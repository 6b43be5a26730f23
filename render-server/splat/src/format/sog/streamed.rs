//! Streamed SOG: a scene in chunks at several levels of detail. Each chunk is a separate SOG scene.
//! The tree in `lod-meta.json` lists, for each of its nodes and each level, the chunk and the range
//! of splats in it (PlayCanvas's specification, version 1, and earlier files without a version).
//! This module reads one level and the environment, because all of it is rendered.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::super::{FormatError, Loaded, limit};
use crate::Splats;
use crate::format::{DropCounts, Format};

/// File name of the tree.
pub(in crate::format) const LOD_META: &str = "lod-meta.json";

/// Content of `lod-meta.json`.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Index {
    version: Option<u32>,
    lod_levels: u32,
    /// Splats around the scene, for every level.
    environment: Option<String>,
    filenames: Vec<String>,
    tree: Node,
}

#[derive(Deserialize)]
struct Node {
    #[serde(default)]
    children: Vec<Self>,
    #[serde(default)]
    lods: BTreeMap<u32, Run>,
}

/// Consecutive splats of a chunk.
#[derive(Clone, Copy, Deserialize)]
struct Run {
    file: usize,
    offset: usize,
    count: usize,
}

fn invalid(reason: impl Into<String>) -> FormatError {
    FormatError::Invalid { format: Format::Sog, place: LOD_META.into(), reason: reason.into() }
}

/// Returns one level of a streamed scene, given its `lod-meta.json`; 0 is the finest level. `open`
/// reads a chunk by its name in the tree. If a part lacks the level, its next finer level is used.
///
/// # Errors
/// Returns an error if the tree is invalid, the level does not exist, or a chunk cannot be read.
pub fn assemble_streamed(
    index: &[u8],
    level: u32,
    open: impl FnMut(&str) -> Result<Loaded, FormatError>,
) -> Result<Loaded, FormatError> {
    let mut whole = Whole::default();
    each_chunk(index, level, open, |chunk, wanted| whole.add(chunk, wanted))?;
    whole.finish()
}

/// Visits the splats of one level, chunk by chunk, then the environment. The second argument of
/// `visit` is the number of splats before invalid ones were dropped.
pub(in crate::format) fn each_chunk<E: From<FormatError>>(
    index: &[u8],
    level: u32,
    mut open: impl FnMut(&str) -> Result<Loaded, FormatError>,
    mut visit: impl FnMut(Loaded, usize) -> Result<(), E>,
) -> Result<(), E> {
    let index: Index = serde_json::from_slice(index).map_err(|error| invalid(error.to_string()))?;
    if let Some(version) = index.version.filter(|&version| version != 1) {
        return Err(E::from(FormatError::Unsupported {
            format: Format::Sog,
            what: format!("version {version} of {LOD_META}"),
            advice: "save it as version 1, or as one .sog",
        }));
    }
    if level >= index.lod_levels {
        let most = index.lod_levels.saturating_sub(1);
        return Err(E::from(invalid(format!("no level {level}; there are 0 to {most}"))));
    }
    let mut runs: BTreeMap<usize, Vec<Run>> = BTreeMap::new();
    collect(&index.tree, level, &mut runs);
    for (file, runs) in runs {
        let name = index.filenames.get(file);
        let name = name.ok_or_else(|| invalid(format!("no file {file} among its filenames")))?;
        let wanted = runs.iter().fold(0usize, |sum, run| sum.saturating_add(run.count));
        limit::count(Format::Sog, wanted as u64)?;
        let mut chunk = open(name)?;
        keep(&mut chunk, &runs, wanted, name)?;
        visit(chunk, wanted)?;
    }
    if let Some(name) = &index.environment {
        let chunk = open(name)?;
        let held = chunk.splats.len() + chunk.dropped.total();
        visit(chunk, held)?;
    }
    Ok(())
}

/// Lists the runs of a level, by file. The JSON parser limits the depth of the recursion.
fn collect(node: &Node, level: u32, runs: &mut BTreeMap<usize, Vec<Run>>) {
    // A finer level has a lower number.
    if let Some((_, &run)) = node.lods.range(..=level).next_back().filter(|(_, run)| run.count > 0)
    {
        runs.entry(run.file).or_default().push(run);
    }
    node.children.iter().for_each(|child| collect(child, level, runs));
}

/// Concatenated chunks.
#[derive(Default)]
struct Whole {
    chunks: Vec<Splats>,
    dropped: DropCounts,
    declared: usize,
    antialiased: bool,
}

impl Whole {
    /// Adds a chunk that had `wanted` splats before invalid ones were dropped.
    fn add(&mut self, chunk: Loaded, wanted: usize) -> Result<(), FormatError> {
        self.declared = self.declared.saturating_add(wanted);
        limit::count(Format::Sog, self.declared as u64)?;
        self.antialiased |= chunk.splats.antialiased;
        self.dropped = self.dropped.plus(chunk.dropped);
        self.chunks.push(chunk.splats);
        Ok(())
    }

    fn finish(self) -> Result<Loaded, FormatError> {
        let mut whole = Splats {
            sh_degree: self.chunks.iter().map(|chunk| chunk.sh_degree).max().unwrap_or(0),
            antialiased: self.antialiased,
            ..Splats::default()
        };
        let numbers = whole.sh_coefficients() * 3;
        for mut chunk in self.chunks {
            let own = chunk.sh_coefficients() * 3;
            for sh in chunk.sh.chunks_exact(own) {
                whole.sh.extend_from_slice(sh);
                whole.sh.resize(whole.sh.len() + numbers - own, 0.0);
            }
            whole.means_m.append(&mut chunk.means_m);
            whole.scales_m.append(&mut chunk.scales_m);
            whole.rotations.append(&mut chunk.rotations);
            whole.opacities.append(&mut chunk.opacities);
        }
        Loaded::whole(Format::Sog, self.declared, whole, self.dropped)
    }
}

/// Keeps only the splats of `runs` in a chunk, `wanted` in all.
fn keep(chunk: &mut Loaded, runs: &[Run], wanted: usize, name: &str) -> Result<(), FormatError> {
    let held = chunk.splats.len() + chunk.dropped.total();
    let beyond = |run: &&Run| run.offset.saturating_add(run.count) > held;
    if let Some(Run { offset, count, .. }) = runs.iter().find(beyond) {
        return Err(invalid(format!(
            "{count} splats from {offset} on of {name}, which has {held}"
        )));
    }
    if wanted < held {
        if chunk.dropped.total() > 0 {
            return Err(invalid(format!(
                "{name} has invalid splats, so the splats of a part cannot be identified"
            )));
        }
        chunk.splats = taken(&chunk.splats, runs);
    }
    Ok(())
}

/// Returns the splats of `runs`.
fn taken(splats: &Splats, runs: &[Run]) -> Splats {
    let mut taken = Splats {
        sh_degree: splats.sh_degree,
        antialiased: splats.antialiased,
        ..Splats::default()
    };
    let numbers = splats.sh_coefficients() * 3;
    for &Run { offset, count, .. } in runs {
        let rows = offset..offset + count;
        taken.means_m.extend_from_slice(&splats.means_m[rows.clone()]);
        taken.scales_m.extend_from_slice(&splats.scales_m[rows.clone()]);
        taken.rotations.extend_from_slice(&splats.rotations[rows.clone()]);
        taken.opacities.extend_from_slice(&splats.opacities[rows.clone()]);
        taken.sh.extend_from_slice(&splats.sh[offset * numbers..(offset + count) * numbers]);
    }
    taken
}
