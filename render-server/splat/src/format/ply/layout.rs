//! Which properties of a vertex make a splat, and where they lie in its row.

use super::PlyError;
use super::header::{Element, Header, PropertyKind, Scalar};

/// Properties every splat has, in the order in which [`Layout::slots`] lists them.
pub(super) const REQUIRED: [&str; 14] = [
    "x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity",
    "f_dc_0", "f_dc_1", "f_dc_2",
];

/// Where in [`Layout::slots`] each group starts.
pub(super) mod slot {
    pub(in crate::format::ply) const MEAN: usize = 0;
    pub(in crate::format::ply) const LOG_SCALE: usize = 3;
    pub(in crate::format::ply) const ROTATION_WXYZ: usize = 6;
    pub(in crate::format::ply) const OPACITY_LOGIT: usize = 10;
    pub(in crate::format::ply) const SH_DC: usize = 11;
    pub(in crate::format::ply) const SH_REST: usize = 14;
}

/// One number of a splat: the column it stands in.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slot {
    /// Index among the vertex element's properties.
    pub(super) column: usize,
    pub(super) scalar: Scalar,
}

/// The columns that make a splat.
#[derive(Clone, Debug)]
pub(super) struct Layout {
    /// [`REQUIRED`], then `f_rest_0..`, which are channel-major: all of red, green, blue.
    pub(super) slots: Vec<Slot>,
    /// The degree that is kept, 0 to 3.
    pub(super) sh_degree: u8,
    /// Harmonics beyond the constant that are kept, per channel.
    pub(super) rest_per_channel: usize,
    /// The constant is not a harmonic but a colour of 0 to 255.
    pub(super) colour_bytes: bool,
}

/// What splatfacto writes instead of `f_dc_*` when it trained without harmonics.
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
            // Degree 4 is rare and adds little: its own coefficients are skipped.
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

    /// Returns the names of the vertex's columns that no splat needs.
    pub(super) fn skipped(&self, header: &Header) -> Vec<String> {
        let used = |column| self.slots.iter().any(|slot| slot.column == column);
        let properties = header.vertex().properties.iter().enumerate();
        properties.filter(|&(i, _)| !used(i)).map(|(_, p)| p.name.clone()).collect()
    }
}

fn column(vertex: &Element, name: &str) -> Option<usize> {
    vertex.properties.iter().position(|property| property.name == name)
}

/// Reports what a PLY without splats seems to be.
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
