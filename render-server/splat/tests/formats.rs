//! Files written by third-party tools from known splats; the files next to them document how they were made.

use std::path::{Path, PathBuf};

use vizflyt_splat::Splats;
use vizflyt_splat::format::{self, Format, Loaded};

/// Maximum loss of a format: whole quantisation steps, because some writers truncate and others round.
struct Loss {
    mean_m: f32,
    log_scale: f32,
    rotation_rad: f32,
    opacity: f32,
    constant: f32,
    harmonic: f32,
}

/// One step of a colour byte, as a constant harmonic.
const COLOUR: f32 = 1.0 / 255.0 / 0.282_094_8;
const BYTES: Loss = Loss {
    mean_m: 1e-5,
    log_scale: 1e-4,
    rotation_rad: 0.03,
    opacity: 1.01 / 255.0,
    constant: COLOUR * 1.01,
    harmonic: 1e-5,
};
const SPZ: Loss = Loss {
    mean_m: 1.0 / 4096.0,
    log_scale: 1.0 / 16.0,
    rotation_rad: 0.01,
    constant: 1.01 / 255.0 / 0.15,
    harmonic: 1.0 / 8.0,
    ..BYTES
};
const KSPLAT: Loss = Loss { mean_m: 5.0 / 65535.0, log_scale: 2e-3, rotation_rad: 3e-3, ..BYTES };

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/formats").join(name)
}

fn read(name: &str) -> Loaded {
    format::read(data(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// Reads a file and compares it with the known scene of its degree, each splat with its nearest one.
fn check(name: &str, expected: Format, sh_degree: u8, loss: &Loss) {
    let loaded = read(name);
    let known: Splats = read(&format!("known-sh{sh_degree}.ply")).splats;
    let found = &loaded.splats;
    assert_eq!((loaded.format, found.len()), (expected, known.len()), "{name}");
    assert_eq!((found.sh_degree, loaded.dropped.total()), (sh_degree, 0), "{name}");
    let numbers = known.sh_coefficients() * 3;
    let mut taken = vec![false; found.len()];
    for i in 0..known.len() {
        let distance_m = |&j: &usize| found.means_m[j].distance_squared(known.means_m[i]);
        let j = (0..found.len())
            .min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)))
            .expect("there are splats");
        assert!(!std::mem::replace(&mut taken[j], true), "{name}: splat {j} is nearest to two");
        let near = |what: &str, a: f32, b: f32, most: f32| {
            assert!((a - b).abs() <= most, "{name}, splat {i}, {what}: {a} became {b}");
        };
        for axis in 0..3 {
            near("position", known.means_m[i][axis], found.means_m[j][axis], loss.mean_m);
            let [a, b] = [known.scales_m[i][axis], found.scales_m[j][axis]].map(f32::ln);
            near("log scale", a, b, loss.log_scale);
        }
        let (q, r) = (known.rotations[i], found.rotations[j]);
        let angle_rad = (q - r).length().min((q + r).length()) * 2.0;
        near("rotation", 0.0, angle_rad, loss.rotation_rad);
        near("opacity", known.opacities[i], found.opacities[j], loss.opacity);
        for k in 0..numbers {
            let most = if k < 3 { loss.constant } else { loss.harmonic };
            near("harmonic", known.sh[i * numbers + k], found.sh[j * numbers + k], most);
        }
    }
}

#[test]
fn splat_transform_compressed_ply() {
    let loss = Loss {
        mean_m: 6.9 / 1023.0,
        log_scale: 2.5 / 1023.0,
        rotation_rad: 0.01,
        harmonic: 1.0 / 32.0,
        ..BYTES
    };
    let name = "splat-transform-compressed-ply-sh3.compressed.ply";
    check(name, Format::CompressedPly, 3, &loss);
}

#[test]
fn splat_transform_sog() {
    let loss = Loss {
        mean_m: 4.4 * 2.0 * 1.5 / 65535.0,
        log_scale: 0.05,
        rotation_rad: 0.04,
        constant: 0.06,
        harmonic: 0.03,
        ..BYTES
    };
    check("splat-transform-sog-sh2.sog", Format::Sog, 2, &loss);
}

#[test]
fn splat_transform_glb() {
    let exact = Loss {
        log_scale: 1e-5,
        rotation_rad: 1e-3,
        opacity: 1e-6,
        constant: 1e-6,
        harmonic: 1e-5,
        ..BYTES
    };
    check("splat-transform-glb-sh2.glb", Format::Gltf, 2, &exact);
}

#[test]
fn splat_transform_streamed_sog() {
    let folder = data("splat-transform-streamed-sh1");
    // 128 splats of degree 1 at the finest level, 40 at the other, and 128 of degree 0 in the environment.
    let finest = format::read(&folder).expect("a scene");
    assert_eq!(finest, format::read(folder.join("lod-meta.json")).expect("a scene"));
    assert_eq!((finest.splats.len(), finest.splats.sh_degree), (256, 1));
    assert_eq!(format::read_level(&folder, 1).expect("a scene").splats.len(), 168);
    // Each chunk of the scene is also a readable file.
    let chunk = format::read(folder.join("0_0/meta.json")).expect("a scene").splats;
    assert_eq!(finest.splats.means_m[..128], chunk.means_m);
    assert_eq!(finest.splats.sh[..128 * 12], chunk.sh);
    let known = read("known-sh1.ply").splats;
    for mean_m in &known.means_m {
        let near = |other: &glam::Vec3| other.distance(*mean_m) < 5e-4;
        assert!(finest.splats.means_m.iter().any(near), "{mean_m}");
    }
    let error = format::read_level(&folder, 2).unwrap_err().to_string();
    assert!(error.contains("no level 2"), "{error}");
}

#[test]
fn spz_of_every_container() {
    check("splat-transform-spz3-sh3.spz", Format::Spz, 3, &SPZ);
    check("splat-transform-spz4-sh1.spz", Format::Spz, 1, &SPZ);
    // Version 2 stores three bytes of the quaternion, from which w follows: inaccurate near half a turn.
    let loss = Loss { rotation_rad: 0.3, ..SPZ };
    check("gaussforge-spz2-sh2.spz", Format::Spz, 2, &loss);
}

#[test]
fn gaussforge_splat() {
    check("gaussforge-splat-sh0.splat", Format::Splat, 0, &BYTES);
}

#[test]
fn gaussian_splats_3d_of_every_level() {
    let exact = Loss { mean_m: 1e-5, log_scale: 1e-4, rotation_rad: 1e-3, ..BYTES };
    check("gaussian-splats-3d-ksplat0-sh1.ksplat", Format::Ksplat, 1, &exact);
    let halves = Loss { harmonic: 1e-3, ..KSPLAT };
    check("gaussian-splats-3d-ksplat1-sh2.ksplat", Format::Ksplat, 2, &halves);
    let bytes = Loss { harmonic: 1.8 / 255.0, ..KSPLAT };
    check("gaussian-splats-3d-ksplat2-sh2.ksplat", Format::Ksplat, 2, &bytes);
}
