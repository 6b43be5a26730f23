//! Layout of a vertex: the properties of a splat and their columns.

use super::PlyError;
use super::header::{Element, Header, PropertyKind, Scalar};

/// Required properties of a splat, in the order of [`Layout::slots`].
pub(super) const REQUIRED: [&str; 14] = [
    "x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity",
    "f_dc_0", "f_dc_1", "f_dc_2",
];

/// Start of each group in [`Layout::slots`].
pub(super) mod slot {
    pub(in crate::format::ply) const MEAN: usize = 0;
    pub(in crate::format::ply) const LOG_SCALE: usize = 3;
    pub(in crate::format::ply) const ROTATION_WXYZ: usize = 6;
    pub(in crate::format::ply) const OPACITY_LOGIT: usize = 10;
    pub(in crate::format::ply) const SH_DC: usize = 11;
    pub(in crate::format::ply) const SH_REST: usize = 14;
}

/// Column of one number of a splat.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slot {
    /// Index among the properties of the vertex element.
    pub(super) column: usize,
    pub(super) scalar: Scalar,
}

/// Columns of a splat.
#[derive(Clone, Debug)]
pub(super) struct Layout {
    /// Columns of [`REQUIRED`], then of `f_rest_0..`, which are channel-major: all of red, green,
    /// blue.
    pub(super) slots: Vec<Slot>,
    /// Degree of the stored harmonics, 0 to 3.
    pub(super) sh_degree: u8,
    /// Stored harmonics per channel, without the constant.
    pub(super) rest_per_channel: usize,
    /// Whether the constant harmonic is given as a colour of 0 to 255.
    pub(super) colour_bytes: bool,
}

/// Properties that splatfacto writes instead of `f_dc_*` after training without harmonics.
const COLOUR: [&str; 3] = ["red", "green", "blue"];

impl Layout {
    /// Finds the columns of a splat in a header.
    pub(super) fn find(header: &Header) -> Result<Self, PlyError> {
        let vertex = header.vertex();
        let lacks = |names: &[&str]| names.iter().any(|name| column(vertex, name).is_none());
        let mut names = REQUIRED;
        let colour_bytes = lacks(&REQUIRED[slot::SH_DC..]) && !lacks(&COLOUR);
        if colour_bytes {
            names[slot::SH_DC..].copy_from_slice(&COLOUR);
        }
        let missing: Vec<&str> =
            names.into_iter().filter(|name| column(vertex, name).is_none()).collect();
        if !missing.is_empty() {
            return Err(PlyError::NotSplats { reason: describe(header, &missing) });
        }
        let rest = vertex.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
        let sh_degree = match rest {
            0 => 0,
            9 => 1,
            24 => 2,
            // Degree 4 is rare and adds little: its additional coefficients are skipped.
            45 | 72 => 3,
            found => return Err(PlyError::HarmonicsCount { found }),
        };
        let rest_per_channel = rest / 3;
        let kept_per_channel = (usize::from(sh_degree) + 1).pow(2) - 1;
        let rest_names: Vec<String> = (0..3)
            .flat_map(|channel| (0..kept_per_channel).map(move |k| channel * rest_per_channel + k))
            .map(|i| format!("f_rest_{i}"))
            .collect();
        let slots = names
            .into_iter()
            .chain(rest_names.iter().map(String::as_str))
            .map(|name| {
                let column = column(vertex, name).ok_or_else(|| PlyError::NotSplats {
                    reason: format!("{rest} f_rest properties, but `{name}` is not among them"),
                })?;
                match vertex.properties[column].kind {
                    PropertyKind::Scalar(scalar) => Ok(Slot { column, scalar }),
                    PropertyKind::List { .. } => Err(PlyError::NotSplats {
                        reason: format!("property `{name}` is a list, not one number"),
                    }),
                }
            })
            .collect::<Result<_, _>>()?;
        Ok(Self { slots, sh_degree, rest_per_channel: kept_per_channel, colour_bytes })
    }

    /// Returns the names of the vertex properties that are not part of a splat.
    pub(super) fn skipped(&self, header: &Header) -> Vec<String> {
        let used = |column| self.slots.iter().any(|slot| slot.column == column);
        let properties = header.vertex().properties.iter().enumerate();
        properties.filter(|&(i, _)| !used(i)).map(|(_, p)| p.name.clone()).collect()
    }
}

fn column(vertex: &Element, name: &str) -> Option<usize> {
    vertex.properties.iter().position(|property| property.name == name)
}

/// Returns a description of a PLY without splats.
fn describe(header: &Header, missing: &[&str]) -> String {
    let names = missing.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
    let kind = if header.elements.iter().any(|e| e.name == "face") {
        "this is a mesh; export Gaussian splats"
    } else if missing.len() > 8 {
        "this is a point cloud; train and export Gaussian splats"
    } else {
        "export Gaussian splats in INRIA's layout"
    };
    format!("the vertices lack {names}: {kind}")
}
