//! Streamed SOG: a scene cut into chunks, each a SOG scene of its own, at several levels of detail, and `lod-meta.json`,
//! a tree that names of each of its nodes where in which chunk each level's splats are. (PlayCanvas's specification,
//! version 1, and the files before it had versions.) One level is read, and what surrounds the scene: all of it is
//! rendered anyway.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::super::{FormatError, Loaded, limit};
use crate::Splats;
use crate::format::{DropCounts, Format};

/// The name of the tree's file.
pub(in crate::format) const LOD_META: &str = "lod-meta.json";

/// The tree, and what it names.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Index {
    version: Option<u32>,
    lod_levels: u32,
    /// What surrounds the scene, at every level.
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

/// Returns one level of a streamed scene, 0 being the finest, given its `lod-meta.json` and what `open`s a chunk by the
/// name that stands there. Where a part has no such level, its next finer one.
///
/// # Errors
/// A tree that is none, a level that it lacks, or whatever keeps a chunk from being read.
pub fn assemble_streamed(
    index: &[u8],
    level: u32,
    open: impl FnMut(&str) -> Result<Loaded, FormatError>,
) -> Result<Loaded, FormatError> {
    let mut whole = Whole::default();
    each_chunk(index, level, open, |chunk, wanted| whole.add(chunk, wanted))?;
    whole.finish()
}

/// Visits what one level has of each chunk, and how many splats that was before faulty ones were left out; then what
/// surrounds the scene.
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

/// Lists the runs of a level, by file. As deep as JSON may be.
fn collect(node: &Node, level: u32, runs: &mut BTreeMap<usize, Vec<Run>>) {
    // The next finer one has the lower number.
    if let Some((_, &run)) = node.lods.range(..=level).next_back().filter(|(_, run)| run.count > 0)
    {
        runs.entry(run.file).or_default().push(run);
    }
    node.children.iter().for_each(|child| collect(child, level, runs));
}

/// Chunks put together.
#[derive(Default)]
struct Whole {
    chunks: Vec<Splats>,
    dropped: DropCounts,
    declared: usize,
    antialiased: bool,
}

impl Whole {
    /// Adds a chunk that has been `wanted` splats.
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

/// Leaves of a chunk the splats of runs, `wanted` in all.
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
                "{name} has faulty splats, so that those of a part are unknown"
            )));
        }
        chunk.splats = taken(&chunk.splats, runs);
    }
    Ok(())
}

/// Returns the splats of runs that lie within them.
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
