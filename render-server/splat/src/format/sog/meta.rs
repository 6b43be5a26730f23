//! `meta.json` of versions 1 and 2, as tables that map bytes to values.

use serde::Deserialize;

use super::files::META;
use super::invalid;
use crate::format::activate::sigmoid;
use crate::format::{Format, FormatError};

/// Value of each byte.
pub(super) type Table = [f32; 256];

/// Metadata of a scene, of either version.
pub(super) struct Meta {
    pub(super) count: usize,
    pub(super) antialiased: bool,
    /// Bounds of the positions, which are stored as logarithms.
    pub(super) mean_min: [f32; 3],
    pub(super) mean_max: [f32; 3],
    /// File of the low bytes, file of the high bytes.
    pub(super) mean_files: [String; 2],
    /// Standard deviation, for each axis. [m]
    pub(super) scales: [Table; 3],
    pub(super) scale_file: String,
    pub(super) quaternion_file: String,
    /// Constant harmonic, for each channel.
    pub(super) colours: [Table; 3],
    /// Opacity, 0 to 1.
    pub(super) opacity: Table,
    pub(super) colour_file: String,
    pub(super) palette: Option<Palette>,
}

/// Palette of the harmonics beyond the constant.
pub(super) struct Palette {
    /// Degree, if the metadata contains it; otherwise it follows from the width of the texture.
    pub(super) bands: Option<u8>,
    /// Number of entries, if the metadata contains it.
    pub(super) count: Option<usize>,
    pub(super) values: Table,
    /// File of the palette, file of the indices.
    pub(super) files: [String; 2],
}

impl Meta {
    /// Returns the names of all files of the scene.
    pub(super) fn files(&self) -> impl Iterator<Item = &str> {
        let single = [&self.scale_file, &self.quaternion_file, &self.colour_file];
        let palette = self.palette.iter().flat_map(|palette| &palette.files);
        self.mean_files.iter().chain(single).chain(palette).map(String::as_str)
    }

    /// Parses `meta.json`.
    pub(super) fn parse(bytes: &[u8]) -> Result<Self, FormatError> {
        let meta: Json =
            serde_json::from_slice(bytes).map_err(|error| invalid(META, error.to_string()))?;
        match meta.version {
            // Version 1 has no version field. Early files of version 2 also lack it, but they have
            // codebooks.
            None | Some(1 | 2) => {}
            Some(version) => {
                return Err(FormatError::Unsupported {
                    format: Format::Sog,
                    what: format!("version {version}"),
                    advice: "convert it to version 2, or to PLY",
                });
            }
        }
        let count = meta
            .count
            .or_else(|| meta.means.shape.as_ref()?.first().copied())
            .ok_or_else(|| invalid(META, "neither `count` nor `means.shape`"))?;
        let scales = meta.scales.tables("scales")?;
        let colours = meta.sh0.tables("sh0")?;
        // Version 1 stores the logit, version 2 the opacity.
        let opacity = match meta.sh0.codebook {
            None => meta.sh0.bounds("sh0", 3)?.map(sigmoid),
            Some(_) => std::array::from_fn(|byte| byte as f32 / 255.0),
        };
        let palette = meta.harmonics.map(|part| {
            let values = match (&part.codebook, part.mins, part.maxs) {
                (Some(codebook), _, _) => expand(codebook, "shN")?,
                (None, Some(min), Some(max)) => between(min, max),
                _ => return Err(invalid(META, "`shN` has neither a codebook nor bounds")),
            };
            if part.bands.is_some_and(|bands| !(1..=3).contains(&bands)) {
                return Err(invalid(META, "`shN.bands` is not 1, 2 or 3"));
            }
            let files = files(part.files, "shN")?;
            Ok(Palette { bands: part.bands, count: part.count, values, files })
        });
        let [scale_file] = files(meta.scales.files, "scales")?;
        let [quaternion_file] = files(meta.quats.files, "quats")?;
        let [colour_file] = files(meta.sh0.files, "sh0")?;
        Ok(Self {
            count: usize::try_from(count).map_err(|_| invalid(META, "`count` is too large"))?,
            antialiased: meta.antialias.unwrap_or(false)
                || meta.model.is_some_and(|model| model == "antialiased"),
            mean_min: meta.means.mins,
            mean_max: meta.means.maxs,
            mean_files: files(meta.means.files, "means")?,
            scales: scales.map(|table| table.map(f32::exp)),
            scale_file,
            quaternion_file,
            colours,
            opacity,
            colour_file,
            palette: palette.transpose()?,
        })
    }
}

#[derive(Deserialize)]
struct Json {
    version: Option<u32>,
    count: Option<u64>,
    /// Written by early programs instead of `model`.
    antialias: Option<bool>,
    /// `default`, `antialiased` or `2dgs`.
    model: Option<String>,
    means: JsonMeans,
    scales: JsonChannels,
    quats: JsonFiles,
    sh0: JsonChannels,
    #[serde(rename = "shN")]
    harmonics: Option<JsonPalette>,
}

#[derive(Deserialize)]
struct JsonMeans {
    shape: Option<Vec<u64>>,
    mins: [f32; 3],
    maxs: [f32; 3],
    files: Vec<String>,
}

#[derive(Deserialize)]
struct JsonFiles {
    files: Vec<String>,
}

#[derive(Deserialize)]
struct JsonChannels {
    codebook: Option<Codebook>,
    mins: Option<Vec<f32>>,
    maxs: Option<Vec<f32>>,
    files: Vec<String>,
}

#[derive(Deserialize)]
struct JsonPalette {
    count: Option<usize>,
    bands: Option<u8>,
    codebook: Option<Codebook>,
    mins: Option<f32>,
    maxs: Option<f32>,
    files: Vec<String>,
}

/// Values in order. Some programs write `null` as the first value.
type Codebook = Vec<Option<f32>>;

impl JsonChannels {
    /// Returns the tables of the first three channels.
    fn tables(&self, part: &str) -> Result<[Table; 3], FormatError> {
        if let Some(codebook) = &self.codebook {
            return Ok([expand(codebook, part)?; 3]);
        }
        let [a, b, c] = [0, 1, 2].map(|channel| self.bounds(part, channel));
        Ok([a?, b?, c?])
    }

    /// Returns the table of a channel, interpolated between its bounds.
    fn bounds(&self, part: &str, channel: usize) -> Result<Table, FormatError> {
        let bound = |bounds: &Option<Vec<f32>>| bounds.as_ref()?.get(channel).copied();
        match (bound(&self.mins), bound(&self.maxs)) {
            (Some(min), Some(max)) => Ok(between(min, max)),
            _ => Err(invalid(META, format!("`{part}` has neither a codebook nor bounds"))),
        }
    }
}

fn between(min: f32, max: f32) -> Table {
    std::array::from_fn(|byte| min + (max - min) * (byte as f32 / 255.0))
}

/// Returns a codebook as a table. Missing entries are NaN, so that splats that use them are
/// dropped.
fn expand(codebook: &Codebook, part: &str) -> Result<Table, FormatError> {
    if codebook.is_empty() || codebook.len() > 256 {
        let length = codebook.len();
        return Err(invalid(META, format!("the codebook of `{part}` has {length} values")));
    }
    let mut table = [f32::NAN; 256];
    for (out, value) in table.iter_mut().zip(codebook) {
        *out = value.unwrap_or(f32::NAN);
    }
    if codebook[0].is_none() {
        // As in PlayCanvas's viewer: extrapolated from the second value by the mean step.
        table[0] = table[1] + (table[1] - table[255]) / 255.0;
    }
    Ok(table)
}

fn files<const N: usize>(files: Vec<String>, part: &str) -> Result<[String; N], FormatError> {
    files.try_into().map_err(|_| invalid(META, format!("`{part}.files` should name {N} file(s)")))
}
