//! Decoder of glTF: nodes and primitives to splats.

use std::path::Path;

use glam::{DMat3, DMat4, DQuat, DVec3, Quat, Vec3};

use super::accessor::Column;
use super::container::{self, Bytes};
use super::scene::{Node, Primitive, Root};
use super::{EXTENSION, harmonic_name, invalid, unsupported};
use crate::format::block::{Gaussian, decode_all};
use crate::format::progress::Meter;
use crate::format::{Format, FormatError, Loaded, limit};
use crate::harmonics::Turn;

/// Supported required extensions: they do not affect splats, or only permit more types of
/// accessors.
const HARMLESS: [&str; 3] = [EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit"];
/// Maximum number of visited nodes, so that a file cannot refer to a few nodes many times.
const MAX_VISITS: usize = 100_000;
/// Maximum depth of nested nodes.
const MAX_DEPTH: usize = 64;

/// Reads the bytes of a `.glb` or `.gltf`. `folder` is its location, if known.
pub(in crate::format) fn decode(
    bytes: &[u8],
    folder: Option<&Path>,
    meter: &Meter,
) -> Result<Loaded, FormatError> {
    let (root, buffers) = container::open(bytes, folder)?;
    let strange = |name: &&String| !HARMLESS.contains(&name.as_str());
    if let Some(name) = root.extensions_required.iter().find(strange) {
        return Err(unsupported(format!("extension {name}"), "save it without compression"));
    }
    let mut walk = Walk { root: &root, buffers: &buffers, visits: 0, found: Vec::new() };
    for node in roots(&root)? {
        walk.visit(node, DMat4::from_mat3(DMat3::from_diagonal(DVec3::new(-1.0, -1.0, 1.0))), 0)?;
    }
    let found = walk.found;
    if found.is_empty() {
        return Err(FormatError::Unknown { what: format!("a glTF file without {EXTENSION}") });
    }
    let stored: usize = buffers.iter().map(|buffer| buffer.get().len()).sum();
    // Index of the first splat of each field.
    let mut starts = Vec::with_capacity(found.len());
    let mut total = 0u64;
    for field in &found {
        starts.push(total as usize);
        total = total.saturating_add(field.mean.count as u64);
        limit::count(Format::Gltf, total)?;
    }
    let degree = found.iter().map(|field| field.degree).max().unwrap_or(0);
    // A mesh may occur in many nodes.
    let each = 4 * (11 + 3 * u64::from(degree + 1).pow(2));
    limit::inflated(Format::Gltf, total, each, stored)?;
    let count = total as usize;
    meter.expect(count);
    let (splats, dropped) = decode_all(degree, count, meter, |first, block| {
        for i in 0..block.len() {
            let field = starts.partition_point(|&start| start <= first + i) - 1;
            let (gaussian, sh) = found[field].splat(first + i - starts[field]);
            block.put(i, &gaussian, |k, channel| sh[k * 3 + channel]);
        }
    });
    let mut loaded = Loaded::whole(Format::Gltf, count, splats, dropped)?;
    loaded.splats.antialiased = found.iter().all(|field| field.antialiased);
    Ok(loaded)
}

/// Returns the root nodes: those of the scene, or without a scene all nodes that have no parent.
fn roots(root: &Root) -> Result<Vec<usize>, FormatError> {
    if root.scenes.is_empty() {
        let mut inner = vec![false; root.nodes.len()];
        for &child in root.nodes.iter().flat_map(|node| &node.children) {
            if let Some(inner) = inner.get_mut(child) {
                *inner = true;
            }
        }
        return Ok((0..inner.len()).filter(|&node| !inner[node]).collect());
    }
    let scene = root.scenes.get(root.scene.unwrap_or(0));
    scene.map(|scene| scene.nodes.clone()).ok_or_else(|| invalid("scene", "no such scene"))
}

struct Walk<'a> {
    root: &'a Root,
    buffers: &'a [Bytes<'a>],
    visits: usize,
    found: Vec<Field<'a>>,
}

impl Walk<'_> {
    /// Visits a node and its descendants. `outer` transforms coordinates of its parent to those of
    /// the scene.
    fn visit(&mut self, index: usize, outer: DMat4, depth: usize) -> Result<(), FormatError> {
        let place = || format!("node {index}");
        self.visits += 1;
        if self.visits > MAX_VISITS || depth > MAX_DEPTH {
            return Err(invalid(place(), "too many nodes in nodes"));
        }
        let root = self.root;
        let node = root.nodes.get(index).ok_or_else(|| invalid(place(), "no such node"))?;
        let here = outer * matrix(node);
        if let Some(mesh) = node.mesh {
            let mesh = root.meshes.get(mesh).ok_or_else(|| invalid(place(), "no such mesh"))?;
            for primitive in &mesh.primitives {
                self.found.extend(field(root, self.buffers, primitive, here, place)?);
            }
        }
        node.children.iter().try_for_each(|&child| self.visit(child, here, depth + 1))
    }
}

fn matrix(node: &Node) -> DMat4 {
    if let Some(columns) = node.matrix {
        return DMat4::from_cols_array(&columns);
    }
    DMat4::from_scale_rotation_translation(
        node.scale.map_or(DVec3::ONE, DVec3::from),
        node.rotation.map_or(DQuat::IDENTITY, DQuat::from_array),
        node.translation.map_or(DVec3::ZERO, DVec3::from),
    )
}

/// Splats of a primitive, with the transform of one node.
struct Field<'a> {
    mean: Column<'a>,
    scale: Column<'a>,
    rotation: Column<'a>,
    opacity: Column<'a>,
    harmonics: Vec<Column<'a>>,
    degree: u8,
    /// Whether scales are logarithms, as in drafts of the extension.
    logarithms: bool,
    antialiased: bool,
    place: Similarity,
}

/// Returns the splats of a primitive, or `None` if it has none.
fn field<'a>(
    root: &Root,
    buffers: &'a [Bytes<'_>],
    primitive: &Primitive,
    here: DMat4,
    place: impl Fn() -> String,
) -> Result<Option<Field<'a>>, FormatError> {
    let Some(splatting) = &primitive.extensions.splatting else { return Ok(None) };
    if let Some(name) = splatting.extensions.keys().next() {
        return Err(unsupported(format!("extension {name}"), "save it without compression"));
    }
    if let Some(kernel) = splatting.kernel.as_ref().filter(|kernel| *kernel != "ellipse") {
        return Err(unsupported(format!("kernel {kernel:?}"), "train with Gaussian splats"));
    }
    // Drafts name other colour spaces, for example BT.709-sRGB.
    let linear = |space: &&String| space.starts_with("lin") || space.ends_with("inear");
    if let Some(space) = splatting.color_space.as_ref().filter(linear) {
        return Err(unsupported(format!("colour space {space}"), "save it as srgb_rec709_display"));
    }
    let find = |name: &str, kind: &str| {
        let index = primitive.attributes.get(name);
        index.map(|&index| Column::find(root, buffers, index, kind)).transpose()
    };
    let need = |name: &str, kind: &str| {
        find(name, kind)?.ok_or_else(|| invalid(place(), format!("no attribute {name}")))
    };
    let own = |name: &str| format!("{EXTENSION}:{name}");
    let mean = need("POSITION", "VEC3")?;
    let mut harmonics = vec![need(&harmonic_name(0, 0), "VEC3")?];
    let mut degree = 0;
    while degree < 3 && find(&harmonic_name(degree + 1, 0), "VEC3")?.is_some() {
        degree += 1;
        for k in 0..=2 * degree {
            harmonics.push(need(&harmonic_name(degree, k), "VEC3")?);
        }
    }
    let field = Field {
        scale: need(&own("SCALE"), "VEC3")?,
        rotation: need(&own("ROTATION"), "VEC4")?,
        opacity: need(&own("OPACITY"), "SCALAR")?,
        harmonics,
        degree: degree as u8,
        logarithms: false,
        antialiased: splatting.extras.antialiased,
        place: Similarity::of(here, degree as u8).ok_or_else(|| {
            unsupported(
                format!("{} that mirrors, or scales axes differently,", place()),
                "apply its scale before it is saved",
            )
        })?,
        mean,
    };
    let columns =
        [&field.scale, &field.rotation, &field.opacity].into_iter().chain(&field.harmonics);
    if columns.into_iter().any(|column| column.count != field.mean.count) {
        return Err(invalid(place(), "attributes of different lengths"));
    }
    let rows = 0..field.mean.count;
    let logarithms = rows.into_iter().any(|row| (0..3).any(|k| field.scale.at(row, k) < 0.0));
    Ok(Some(Field { logarithms, ..field }))
}

impl Field<'_> {
    /// Returns a splat and its harmonics, in the coordinates of the scene.
    #[inline]
    fn splat(&self, row: usize) -> (Gaussian, [f32; 48]) {
        let three = |column: &Column| Vec3::from_array([0, 1, 2].map(|k| column.at(row, k)));
        let mut sh = [0.0; 48];
        for (rgb, column) in sh.as_chunks_mut::<3>().0.iter_mut().zip(&self.harmonics) {
            *rgb = three(column).to_array();
        }
        let Similarity { rotation, scale, translation_m, turn } = &self.place;
        turn.apply(&mut sh);
        let scale_m = three(&self.scale);
        let scale_m = if self.logarithms { scale_m.exp() } else { scale_m };
        let q = Quat::from_array([0, 1, 2, 3].map(|k| self.rotation.at(row, k)));
        let gaussian = Gaussian {
            mean_m: (*rotation * three(&self.mean).as_dvec3() * *scale + translation_m).as_vec3(),
            scale_m: scale_m * *scale as f32,
            rotation_xyzw: (rotation.as_quat() * q).to_array(),
            opacity: self.opacity.at(row, 0),
        };
        (gaussian, sh)
    }
}

/// Transform of a node.
struct Similarity {
    rotation: DQuat,
    scale: f64,
    translation_m: DVec3,
    turn: Turn,
}

impl Similarity {
    /// Returns the parts of a matrix, or `None` if it is not a similarity.
    fn of(matrix: DMat4, degree: u8) -> Option<Self> {
        let axes = DMat3::from_mat4(matrix);
        let scale = axes.determinant().cbrt();
        let rotation = axes * (1.0 / scale);
        let off = rotation * rotation.transpose() - DMat3::IDENTITY;
        // The comparison is false for NaN, so NaN is rejected.
        let good = scale > 0.0 && off.to_cols_array().iter().all(|v| v.abs() < 1e-3);
        let translation_m = matrix.w_axis.truncate();
        if !(good && translation_m.is_finite()) {
            return None;
        }
        let rotation = DQuat::from_mat3(&rotation).normalize();
        Some(Self { rotation, scale, translation_m, turn: Turn::new(rotation, degree) })
    }
}
