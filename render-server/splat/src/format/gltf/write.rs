//! Encoder of `.glb`: one primitive of f32, with a separate buffer view for each attribute.

use serde_json::{Value, json};

use super::{EXTENSION, harmonic_name};
use crate::Splats;
use crate::format::assert_whole;
use crate::harmonics::Turn;

/// Constants of glTF: component type `FLOAT`, and target of vertex buffer views.
const FLOAT: u32 = 5126;
const ARRAY_BUFFER: u32 = 34962;

/// Returns the bytes of a `.glb` file. Lossless, except for the sign of quaternions.
pub(in crate::format) fn encode(splats: &Splats) -> Vec<u8> {
    assert_whole(splats);
    let (count, coefficients) = (splats.len(), splats.sh_coefficients());
    // Rotation by half a turn about z, as in `read`.
    let turn = Turn::new(glam::DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0), splats.sh_degree);
    let mut sh = splats.sh.clone();
    sh.chunks_exact_mut(coefficients * 3).for_each(|sh| turn.apply(sh));
    let position = |i: usize| {
        let [x, y, z] = splats.means_m[i].to_array();
        [-x, -y, z]
    };

    let mut binary: Vec<u8> = Vec::with_capacity(count * 4 * (11 + coefficients * 3));
    let (mut views, mut accessors, mut attributes) = (Vec::new(), Vec::new(), json!({}));
    let mut put = |name: String, kind: &str, width: usize, row: &dyn Fn(usize, &mut Vec<f32>)| {
        let (start, mut numbers) = (binary.len(), Vec::with_capacity(width));
        for i in 0..count {
            numbers.clear();
            row(i, &mut numbers);
            binary.extend(numbers.iter().flat_map(|v| v.to_le_bytes()));
        }
        let view = json!({ "buffer": 0, "byteOffset": start, "byteLength": binary.len() - start, "target": ARRAY_BUFFER });
        attributes[name] = accessors.len().into();
        accessors.push(json!({ "bufferView": views.len(), "componentType": FLOAT, "count": count, "type": kind }));
        views.push(view);
    };
    put("POSITION".into(), "VEC3", 3, &|i, out| out.extend(position(i)));
    let own = |name: &str| format!("{EXTENSION}:{name}");
    // Product of the half turn about z and the splat's rotation.
    put(own("ROTATION"), "VEC4", 4, &|i, out| {
        let [x, y, z, w] = splats.rotations[i].to_array();
        out.extend([-y, x, w, -z]);
    });
    put(own("SCALE"), "VEC3", 3, &|i, out| out.extend(splats.scales_m[i].to_array()));
    put(own("OPACITY"), "SCALAR", 1, &|i, out| out.push(splats.opacities[i]));
    for degree in 0..=usize::from(splats.sh_degree) {
        for k in 0..=2 * degree {
            let at = (degree * degree + k) * 3;
            let row =
                |i: usize, out: &mut Vec<f32>| out.extend(&sh[i * coefficients * 3 + at..][..3]);
            put(harmonic_name(degree, k), "VEC3", 3, &row);
        }
    }
    // The standard requires the bounds of positions.
    let bound = |pick: fn(f32, f32) -> f32| -> Value {
        let all = (0..count).map(position);
        all.reduce(|a, b| std::array::from_fn(|k| pick(a[k], b[k])))
            .unwrap_or_default()
            .to_vec()
            .into()
    };
    accessors[0]["min"] = bound(f32::min);
    accessors[0]["max"] = bound(f32::max);

    let mut splatting = json!({
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance", "projection": "perspective",
    });
    if splats.antialiased {
        splatting["extras"] = json!({ "antialiased": true });
    }
    let root = json!({
        "asset": { "version": "2.0", "generator": "vizflyt" },
        "extensionsUsed": [EXTENSION],
        "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "buffers": [{ "byteLength": binary.len() }], "bufferViews": views, "accessors": accessors,
        "meshes": [{ "primitives": [{
            "attributes": attributes, "mode": 0, "extensions": { EXTENSION: splatting },
        }] }],
    });
    let mut text = root.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + text.len() + 8 + binary.len();
    let mut bytes = Vec::with_capacity(total);
    bytes.extend_from_slice(super::MAGIC);
    let word =
        |bytes: &mut Vec<u8>, value: usize| bytes.extend_from_slice(&(value as u32).to_le_bytes());
    word(&mut bytes, 2);
    word(&mut bytes, total);
    for (kind, content) in [(b"JSON", &text), (b"BIN\0", &binary)] {
        word(&mut bytes, content.len());
        bytes.extend_from_slice(kind);
        bytes.extend_from_slice(content);
    }
    bytes
}
