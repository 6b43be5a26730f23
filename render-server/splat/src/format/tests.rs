use std::path::Path;

use glam::{Quat, Vec3};
use proptest::prelude::*;

use super::order::morton;
use super::{Format, FormatError, Loaded, Progress};
use super::{
    assemble_streamed, gltf, ksplat, parse, ply, read, read_with_progress, sog, splat, spz, write,
};
use crate::Splats;

/// Writer, the order of splats that it produces, and its maximum errors.
struct FormatCase {
    name: &'static str,
    format: Format,
    encode: fn(&Splats) -> Vec<u8>,
    sorted: fn(&Splats) -> Vec<u32>,
    loss: Loss,
}

/// Maximum errors after encoding and decoding.
struct Loss {
    /// Error of positions, given the extent of the splats that share bounds. [m]
    mean_m: fn(f32) -> f32,
    /// Error of the logarithm of a scale. The scenes of the tests stay within the clamping limits.
    log_scale: f32,
    /// Error of a rotation. [rad]
    rotation_rad: f32,
    /// Error of opacity.
    opacity: f32,
    /// Error of the constant harmonic.
    constant: f32,
    /// Error of the other harmonics.
    harmonic: f32,
}

fn as_is(splats: &Splats) -> Vec<u32> {
    (0..splats.len() as u32).collect()
}

/// Half a step of a colour byte, as a constant harmonic, with a margin for rounding.
const COLOUR_BYTE: f32 = 0.5 / 255.0 / 0.282_094_8 * 1.01;
/// Half a step of an opacity byte.
const OPACITY_BYTE: f32 = 0.5 / 255.0 * 1.01;

const SPZ: Loss = Loss {
    mean_m: |_| 0.5 / 4096.0 + 1e-5,
    log_scale: 1.0 / 32.0 + 1e-4,
    rotation_rad: 0.006,
    opacity: OPACITY_BYTE,
    constant: 0.5 / 255.0 / 0.15 * 1.01,
    // 5 bits at degree 1, 4 bits beyond, plus the clamp of 1 to a byte of 255.
    harmonic: 1.0 / 16.0 + 1.0 / 128.0,
};

const KSPLAT: Loss = Loss {
    mean_m: |_| 2.5 / 32767.0,
    log_scale: 1e-3,
    rotation_rad: 2e-3,
    opacity: OPACITY_BYTE,
    constant: COLOUR_BYTE,
    harmonic: 1e-3,
};

const FORMAT_CASES: [FormatCase; 11] = [
    FormatCase {
        name: "PLY",
        format: Format::Ply,
        encode: ply::encode,
        sorted: as_is,
        loss: Loss {
            mean_m: |_| 0.0,
            log_scale: 1e-5,
            rotation_rad: 1e-3,
            opacity: 1e-6,
            constant: 0.0,
            harmonic: 0.0,
        },
    },
    FormatCase {
        name: "compressed PLY",
        format: Format::CompressedPly,
        encode: ply::encode_compressed,
        sorted: morton,
        loss: Loss {
            mean_m: |extent_m| extent_m / 2046.0 * 1.01,
            // Scales of the tests span 2.5 in the logarithm.
            log_scale: 2.5 / 2046.0 * 1.01,
            // Half a step in three components, and three times that in the fourth if all are equal.
            rotation_rad: 0.005,
            opacity: OPACITY_BYTE,
            constant: COLOUR_BYTE,
            harmonic: 1.0 / 64.0 * 1.01,
        },
    },
    FormatCase {
        name: ".splat",
        format: Format::Splat,
        encode: splat::encode,
        sorted: as_is,
        loss: Loss {
            mean_m: |_| 0.0,
            log_scale: 1e-5,
            rotation_rad: 0.02,
            opacity: OPACITY_BYTE,
            constant: COLOUR_BYTE,
            harmonic: 0.0,
        },
    },
    FormatCase {
        name: "SPZ 2",
        format: Format::Spz,
        encode: |splats| spz::encode(splats, 2),
        sorted: as_is,
        // w is computed from three bytes, so half turns have the largest error.
        loss: Loss { rotation_rad: 0.3, ..SPZ },
    },
    FormatCase {
        name: "SPZ 3",
        format: Format::Spz,
        encode: |splats| spz::encode(splats, 3),
        sorted: as_is,
        loss: SPZ,
    },
    FormatCase {
        name: "SPZ 4",
        format: Format::Spz,
        encode: |splats| spz::encode(splats, 4),
        sorted: as_is,
        loss: SPZ,
    },
    FormatCase {
        name: "SOG",
        format: Format::Sog,
        encode: |splats| sog::encode(splats).unwrap(),
        sorted: morton,
        loss: Loss {
            // ln(1 + 5) to either side in 65535 steps, stretched by 6 at the far end.
            mean_m: |_| 6.0 * 2.0 * 1.8 / 65535.0,
            // A codebook is dense where values are dense: elsewhere, steps can be twice an even
            // step.
            log_scale: 2.5 * 2.0 / 255.0,
            rotation_rad: 0.02,
            opacity: OPACITY_BYTE,
            constant: 2.0 * 2.0 / 255.0,
            harmonic: 2.0 * 2.0 / 255.0,
        },
    },
    FormatCase {
        name: ".ksplat level 0",
        format: Format::Ksplat,
        encode: |splats| ksplat::encode(splats, 0),
        sorted: as_is,
        loss: Loss {
            mean_m: |_| 0.0,
            log_scale: 1e-5,
            rotation_rad: 1e-3,
            harmonic: 0.0,
            ..KSPLAT
        },
    },
    FormatCase {
        name: ".ksplat level 1",
        format: Format::Ksplat,
        encode: |splats| ksplat::encode(splats, 1),
        sorted: by_cube,
        loss: KSPLAT,
    },
    FormatCase {
        name: ".ksplat level 2",
        format: Format::Ksplat,
        encode: |splats| ksplat::encode(splats, 2),
        sorted: by_cube,
        loss: Loss { harmonic: 1.0 / 255.0 * 1.01, ..KSPLAT },
    },
    FormatCase {
        name: "glTF",
        format: Format::Gltf,
        encode: gltf::encode,
        sorted: as_is,
        loss: Loss {
            mean_m: |_| 0.0,
            log_scale: 0.0,
            rotation_rad: 1e-6,
            opacity: 0.0,
            constant: 0.0,
            // Rotated at encoding and rotated back at decoding.
            harmonic: 1e-6,
        },
    },
];

/// Returns the order of `.ksplat`'s cubes of 5 m. The scenes of the tests do not fill a bucket.
fn by_cube(splats: &Splats) -> Vec<u32> {
    let mut order = as_is(splats);
    order.sort_by_key(|&i| (splats.means_m[i as usize] / 5.0).floor().as_ivec3().to_array());
    order
}

/// Generates scenes of up to 40 splats within 5 m, with values that no format clamps.
fn scene() -> impl Strategy<Value = Splats> {
    let splat = (
        prop::array::uniform3(-5.0..5.0f32),
        prop::array::uniform3(-4.5..-2.0f32),
        prop::array::uniform4(-1.0..1.0f32),
        0.0..=1.0f32,
        prop::collection::vec(-1.0..1.0f32, 48),
    );
    let rows = prop::collection::vec(splat, 1..40);
    (0..=3u8, any::<bool>(), rows).prop_map(|(sh_degree, antialiased, rows)| {
        let mut splats = Splats { sh_degree, antialiased, ..Splats::default() };
        let numbers = splats.sh_coefficients() * 3;
        for (mean_m, log_scale, q, opacity, sh) in rows {
            let q = Quat::from_array(q);
            splats.means_m.push(mean_m.into());
            splats.scales_m.push(Vec3::from_array(log_scale.map(f32::exp)));
            splats.rotations.push(if q.length() > 1e-2 { q.normalize() } else { Quat::IDENTITY });
            splats.opacities.push(opacity);
            splats.sh.extend(&sh[..numbers]);
        }
        splats
    })
}

/// Returns a fixed scene of degree 2.
fn some() -> Splats {
    let mut splats = Splats { sh_degree: 2, ..Splats::default() };
    for i in 0..7 {
        let f = i as f32;
        splats.means_m.push(Vec3::new(f.sin() * 3.0, f.cos(), f * 0.5 - 2.0));
        splats.scales_m.push(Vec3::new(0.02 + f * 0.01, 0.03, 0.05));
        splats.rotations.push(Quat::from_xyzw(f - 3.0, 1.0, f * 0.5, -0.5).normalize());
        splats.opacities.push(0.1 + f * 0.1);
        splats.sh.extend((0..27).map(|k| ((k * 5 + i) as f32).sin() * 0.7));
    }
    splats
}

/// Asserts that a decoded scene is within the maximum errors.
fn check_close(case: &FormatCase, before: &Splats, after: &Splats) {
    let FormatCase { name, loss, format, .. } = case;
    let order = (case.sorted)(before);
    assert_eq!(after.len(), before.len(), "{name}");
    assert_eq!(after.sh_degree, before.sh_degree.min(format.max_sh_degree()), "{name}");
    let (old, new) = (before.sh_coefficients() * 3, after.sh_coefficients() * 3);
    for (j, &i) in order.iter().enumerate() {
        let i = i as usize;
        let near = |what: &str, a: f32, b: f32, most: f32| {
            assert!((a - b).abs() <= most, "{name}, splat {i}, {what}: {a} became {b}");
        };
        for axis in 0..3 {
            let [low, high] = [Vec3::min, Vec3::max]
                .map(|pick| before.means_m.iter().copied().reduce(pick).unwrap()[axis]);
            let most = (loss.mean_m)(high - low);
            near("position", before.means_m[i][axis], after.means_m[j][axis], most);
            let [a, b] = [before.scales_m[i][axis], after.scales_m[j][axis]].map(f32::ln);
            near("log scale", a, b, loss.log_scale);
        }
        // The chord, because the cosine of small angles is lost in rounding. A quaternion and its
        // negative are the same rotation.
        let (q, r) = (before.rotations[i], after.rotations[j]);
        let angle_rad = (q - r).length().min((q + r).length()) * 2.0;
        near("rotation", 0.0, angle_rad, loss.rotation_rad);
        near("opacity", before.opacities[i], after.opacities[j], loss.opacity);
        for k in 0..new {
            let most = if k < 3 { loss.constant } else { loss.harmonic };
            near("harmonic", before.sh[i * old + k], after.sh[j * new + k], most);
        }
    }
}

/// Asserts that a scene that was decoded from damaged bytes can be rendered.
fn check_sound(loaded: &Loaded) {
    let s = &loaded.splats;
    assert_eq!(s.sh.len(), s.len() * 3 * s.sh_coefficients());
    assert!(s.means_m.iter().chain(&s.scales_m).all(|v| v.is_finite()));
    assert!(s.rotations.iter().all(|q| q.is_normalized()));
    assert!(s.opacities.iter().all(|o| (0.0..=1.0).contains(o)));
    assert!(s.sh.iter().all(|v| v.is_finite()));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn decodes_every_format_within_its_quantisation_steps(splats in scene()) {
        for case in &FORMAT_CASES {
            let loaded = parse(&(case.encode)(&splats), case.format).unwrap();
            prop_assert_eq!(loaded.format, case.format);
            prop_assert_eq!(loaded.dropped.total(), 0);
            check_close(case, &splats, &loaded.splats);
            let kept = splats.antialiased && case.format.keeps_antialiased();
            prop_assert_eq!(loaded.splats.antialiased, kept, "{}", case.name);
        }
    }

    #[test]
    fn returns_an_error_or_a_valid_scene_for_damaged_bytes(
        splats in scene(), at in any::<prop::sample::Index>(), bits in 1..=255u8,
    ) {
        for case in &FORMAT_CASES {
            let mut bytes = (case.encode)(&splats);
            let at = at.index(bytes.len());
            bytes[at] ^= bits;
            if let Ok(loaded) = parse(&bytes, case.format) {
                check_sound(&loaded);
            }
        }
    }

    #[test]
    fn returns_an_error_or_a_valid_scene_for_random_bytes(bytes in prop::collection::vec(any::<u8>(), 0..6000)) {
        for format in Format::ALL {
            if let Ok(loaded) = super::decode(&bytes, format, None, &super::Meter::SILENT) {
                check_sound(&loaded);
            }
        }
    }
}

#[test]
fn rejects_a_file_truncated_anywhere() {
    for case in &FORMAT_CASES {
        let bytes = (case.encode)(&some());
        for length in 0..bytes.len() {
            // A `.splat` cut between splats is a valid shorter file. The last bytes of a gzip
            // stream are its checksum and length; without them, the file is rejected.
            if case.format == Format::Splat && length % 32 == 0 && length > 0 {
                continue;
            }
            let result = super::decode(&bytes[..length], case.format, None, &super::Meter::SILENT);
            assert!(result.is_err(), "{}: {length} of {} bytes", case.name, bytes.len());
        }
        assert!(parse(&bytes, case.format).is_ok());
    }
}

#[test]
fn detects_the_format_by_content_then_by_name() {
    for case in &FORMAT_CASES {
        let bytes = (case.encode)(&some());
        let marked = case.format != Format::Splat;
        assert_eq!(Format::of_content(&bytes).is_some(), marked, "{}", case.name);
        if marked {
            assert_eq!(parse(&bytes, Format::Splat).unwrap().format, case.format, "{}", case.name);
        }
    }
    for format in Format::ALL {
        let name = format!("a.b.{}", format.extension().to_uppercase());
        assert_eq!(Format::of_name(Path::new(&name)), Some(format), "{name}");
    }
    assert_eq!(Format::of_name(Path::new("x/meta.json")), Some(Format::Sog));
    assert_eq!(Format::of_name(Path::new("ply")), None);
}

#[test]
fn reads_files_and_folders_by_path() {
    let folder = tempfile::tempdir().unwrap();
    for format in Format::ALL {
        let path = folder.path().join("scene").with_extension(format.extension());
        write(&path, &some()).unwrap();
        let mut reports = Vec::new();
        let loaded = read_with_progress(&path, &mut |progress| reports.push(progress)).unwrap();
        assert_eq!((loaded.format, loaded.splats.len()), (format, 7));
        assert_eq!(loaded, read(&path).unwrap());
        let last = *reports.last().unwrap();
        assert_eq!(last.done, last.total, "{format}");
        assert!(last.total >= 7 && reports.is_sorted_by_key(|Progress { done, .. }| *done));
    }
    let loose = folder.path().join("loose");
    std::fs::create_dir(&loose).unwrap();
    write(loose.join("meta.json"), &some()).unwrap();
    let from_folder = read(&loose).unwrap();
    assert_eq!(from_folder, read(loose.join("meta.json")).unwrap());
    assert_eq!(from_folder, read(folder.path().join("scene.sog")).unwrap());
}

#[test]
fn rejects_unknown_files_with_the_list_of_formats() {
    let folder = tempfile::tempdir().unwrap();
    let check = |name: &str, bytes: &[u8], parts: &[&str]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let error = read(&path).unwrap_err().to_string();
        for part in parts {
            assert!(error.contains(part), "{error:?} lacks {part:?}");
        }
    };
    check("a.glb", b"glTF\x02\0\0\0", &["glTF: truncated"]);
    check(
        "a.obj",
        b"o thing\n",
        &["a.obj is not a scene file: it starts with \"o thing", "PLY (.ply)", "glTF (.glb)"],
    );
    check("a.gltf", b"{}", &["a glTF file without KHR_gaussian_splatting"]);
    check("a.usdz", b"PK\x05\x06", &["is not a scene file"]);
    check("lod-meta.json", b"{}", &["SOG, lod-meta.json", "lodLevels"]);
    std::fs::remove_file(folder.path().join("lod-meta.json")).unwrap();
    check("a.splat", b"", &["no splats"]);
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n";
    check("b.splat", pointer, &["b.splat is a pointer of Git LFS", "git lfs pull"]);
    check("c.splat", b"\n<!DOCTYPE html><html>", &["c.splat is a web page"]);
    check("d.ply", b"<HTML><body>404", &["d.ply is a web page"]);
    check("a.ksplat", &[0; 5000], &["version 0.0"]);
    check("meta.json", b"{}", &["SOG, meta.json"]);
    assert!(matches!(read("/nowhere/x.spz"), Err(FormatError::Io { .. })));
    let error = write(folder.path().join("x.obj"), &some()).unwrap_err().to_string();
    assert!(error.contains("has no extension of a writable format; supported are PLY"), "{error}");
}

#[test]
fn rejects_a_pipe_without_waiting() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pipe.splat");
    let made = std::process::Command::new("mkfifo").arg(&path).status().unwrap();
    assert!(made.success());
    // The pipe has no writer: opening it would block.
    let error = read(&path).unwrap_err().to_string();
    assert!(error.contains("not a regular file"), "{error}");
}

#[test]
fn writes_an_empty_scene_and_rejects_it_on_reading() {
    for case in &FORMAT_CASES {
        let result = parse(&(case.encode)(&Splats::default()), case.format);
        let error = result.expect_err(case.name).to_string();
        assert!(error.contains("no splats"), "{}: {error}", case.name);
    }
}

#[test]
fn clamps_values_beyond_the_range_of_a_format() {
    let mut splats = some();
    splats.means_m[0] = Vec3::new(4e4, -3e7, 0.5);
    splats.scales_m[1] = Vec3::new(0.0, 1e-30, 1e3);
    splats.opacities[2] = 0.0;
    splats.opacities[3] = 1.0;
    splats.sh[20] = 50.0;
    splats.sh[21] = -50.0;
    for case in &FORMAT_CASES {
        let loaded = parse(&(case.encode)(&splats), case.format).unwrap();
        assert_eq!((loaded.splats.len(), loaded.dropped.total()), (7, 0), "{}", case.name);
        check_sound(&loaded);
    }
}

#[test]
fn starts_another_bucket_or_chunk_when_one_is_full() {
    let mut splats = Splats { sh_degree: 1, ..Splats::default() };
    for i in 0..1300 {
        let f = i as f32;
        splats.means_m.push(Vec3::new(f * 0.003, (f * 0.01).sin(), f % 7.0));
        splats.scales_m.push(Vec3::splat(0.05));
        splats.rotations.push(Quat::IDENTITY);
        splats.opacities.push(0.5);
        splats.sh.extend((0..12).map(|k| (f + k as f32).sin() * 0.9));
    }
    for case in &FORMAT_CASES {
        let after = parse(&(case.encode)(&splats), case.format).unwrap().splats;
        // In any order: each splat has a counterpart near it, and positions identify the splats.
        let most = (case.loss.mean_m)(7.0) * 2.0;
        let mut before: Vec<Vec3> = splats.means_m.clone();
        let mut after: Vec<Vec3> = after.means_m;
        let key = |m: &Vec3| (m.z.round() as i32, (m.x * 1e3 / 3.0).round() as i32);
        before.sort_by_key(key);
        after.sort_by_key(key);
        for (a, b) in before.iter().zip(&after) {
            assert!((a - b).abs().max_element() <= most, "{}: {a} {b}", case.name);
        }
    }
}

#[test]
fn rejects_hostile_sizes_before_allocating() {
    let refuse = |name: &str, bytes: &[u8], format: Format, part: &str| {
        let error = parse(bytes, format).expect_err(name).to_string();
        assert!(error.contains(part), "{name}: {error:?} lacks {part:?}");
    };
    // SPZ 3: 4 billion splats declared in an empty gzip stream.
    let mut header = Vec::new();
    for word in [spz::MAGIC, 3, u32::MAX] {
        header.extend(word.to_le_bytes());
    }
    header.extend([3, 12, 0, 0]);
    let gzip = |bytes: &[u8]| {
        let mut stream = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
        std::io::Write::write_all(&mut stream, bytes).unwrap();
        stream.finish().unwrap()
    };
    refuse("count", &gzip(&header), Format::Spz, "number of splats is 4294967295");
    header[8..12].copy_from_slice(&30_000_000u32.to_le_bytes());
    refuse("ratio", &gzip(&header), Format::Spz, "size when inflated");
    header[8..12].copy_from_slice(&200_000u32.to_le_bytes());
    refuse("bomb", &gzip(&header), Format::Spz, "truncated: an attribute takes");
    header[4] = 5;
    refuse("version", &gzip(&header), Format::Spz, "version 5 is not supported; save it as");

    // SPZ 4 with a table of contents beyond the file.
    let mut four = spz::encode(&some(), 4);
    four[16..20].copy_from_slice(&u32::MAX.to_le_bytes());
    refuse("table", &four, Format::Spz, "table of contents");
    let mut four = spz::encode(&some(), 4);
    four[32..40].fill(0xff);
    refuse("stream", &four, Format::Spz, "an attribute takes 18446744073709551615 bytes");
    four[40..48].fill(0xff);
    refuse("inflated", &four, Format::Spz, "18446744073709551615 bytes for 7 splats");

    // .ksplat: sections and splats beyond the file.
    let whole = ksplat::encode(&some(), 1);
    for (at, part) in [(4, "section headers"), (4096 + 36, "a section takes")] {
        let mut bytes = whole.clone();
        bytes[at..at + 4].copy_from_slice(&u32::MAX.to_le_bytes());
        refuse("sections", &bytes, Format::Ksplat, part);
    }
    let mut bytes = whole.clone();
    bytes[4096 + 32..4096 + 40].fill(0xff);
    bytes[4096 + 8..4096 + 12].fill(0xff);
    refuse("buckets", &bytes, Format::Ksplat, "truncated");

    // Compressed PLY with fewer chunks than its splats need.
    let text = String::from_utf8_lossy(&ply::encode_compressed(&some())).into_owned();
    let header = text[..text.find("end_header").unwrap()].replace("chunk 1", "chunk 0");
    let mut bytes = (header + "end_header\n").into_bytes();
    bytes.resize(bytes.len() + 7 * (16 + 24), 0);
    refuse("chunks", &bytes, Format::CompressedPly, "0 chunks for 7 splats");
}

/// Returns a ZIP of the given parts.
fn zip(parts: &[(&str, Vec<u8>)], method: zip::CompressionMethod) -> Vec<u8> {
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default().compression_method(method);
    for (name, bytes) in parts {
        archive.start_file(*name, options).unwrap();
        std::io::Write::write_all(&mut archive, bytes).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

#[test]
fn rejects_sog_parts_beyond_their_limits() {
    let parts = sog::parts(&some()).unwrap();
    let meta = String::from_utf8(parts.last().unwrap().1.clone()).unwrap();
    let with = |from: &str, to: &str| {
        assert!(meta.contains(from), "{from}");
        let mut parts: Vec<(&str, Vec<u8>)> = parts.clone();
        parts.last_mut().unwrap().1 = meta.replacen(from, to, 1).into_bytes();
        zip(&parts, zip::CompressionMethod::Stored)
    };
    let refuse = |bytes: &[u8], part: &str| {
        let error = parse(bytes, Format::Sog).unwrap_err().to_string();
        assert!(error.contains(part), "{error:?} lacks {part:?}");
    };
    refuse(&with("\"count\":7,\"means", "\"count\":99,\"means"), "16 pixels for 99 splats");
    refuse(&with("\"count\":7,\"means", "\"count\":9999999999,\"means"), "number of splats");
    refuse(&with("\"count\":7,\"means", "\"count\":30000000,\"means"), "size when inflated");
    refuse(&with("\"version\":2", "\"version\":3"), "version 3 is not supported");
    refuse(&with("\"sh0.webp\"", "\"../sh0.webp\""), "not a file name");
    refuse(&with("\"sh0.webp\"", "\"/etc/hostname\""), "not a file name");
    refuse(&with("\"sh0.webp\"", "\"absent.webp\""), "absent.webp");
    refuse(&with("\"sh0.webp\"", "\"meta.json\""), "not a WebP image");
    refuse(&with("\"bands\":2", "\"bands\":3"), "fits no degree");
    // Deflated, and in a folder of the archive, the scene is the same.
    let named: Vec<(String, Vec<u8>)> =
        parts.iter().map(|(name, bytes)| (format!("my/{name}"), bytes.clone())).collect();
    let named: Vec<(&str, Vec<u8>)> =
        named.iter().map(|(name, bytes)| (name.as_str(), bytes.clone())).collect();
    let deflated = zip(&named, zip::CompressionMethod::Deflated);
    let expected = parse(&sog::encode(&some()).unwrap(), Format::Sog).unwrap();
    assert_eq!(parse(&deflated, Format::Sog).unwrap(), expected);
    // A texture that inflates to more than its splats need.
    let mut bomb: Vec<(&str, Vec<u8>)> = parts.clone();
    bomb[0].1 = vec![0; 8 << 20];
    refuse(&zip(&bomb, zip::CompressionMethod::Deflated), "the size of a part");
    let mut encoded = Vec::new();
    let pixels = vec![0; 4096 * 4096 * 3];
    image_webp::WebPEncoder::new(&mut encoded)
        .encode(&pixels, 4096, 4096, image_webp::ColorType::Rgb8)
        .unwrap();
    bomb[0].1 = encoded;
    refuse(&zip(&bomb, zip::CompressionMethod::Stored), "the number of pixels of a texture");
}

#[test]
fn reads_sog_version_1_between_its_bounds() {
    // Four splats on 4 x 4 pixels; every byte is a value between the bounds.
    let pixels = |pixel: [u8; 4]| -> Vec<u8> {
        let mut webp = Vec::new();
        let bytes: Vec<u8> = std::iter::repeat_n(pixel, 16).flatten().collect();
        image_webp::WebPEncoder::new(&mut webp)
            .encode(&bytes, 4, 4, image_webp::ColorType::Rgba8)
            .unwrap();
        webp
    };
    let meta = br#"{
        "means": { "shape": [4, 3], "dtype": "float32", "mins": [0, -1, -2], "maxs": [1, 0, 2],
            "files": ["means_l.webp", "means_u.webp"] },
        "scales": { "shape": [4, 3], "mins": [-5, -5, -5], "maxs": [0, 0, 0],
            "files": ["scales.webp"] },
        "quats": { "shape": [4, 4], "encoding": "quaternion_packed", "files": ["quats.webp"] },
        "sh0": { "shape": [4, 1, 4], "mins": [-1, 0, 1, -4], "maxs": [1, 2, 3, 4],
            "files": ["sh0.webp"] }
    }"#;
    let parts = [
        ("means_l.webp", pixels([0, 255, 0, 255])),
        ("means_u.webp", pixels([0, 255, 0, 255])),
        ("scales.webp", pixels([0, 255, 51, 255])),
        ("quats.webp", pixels([127, 128, 127, 254])),
        ("sh0.webp", pixels([0, 51, 255, 255])),
        ("meta.json", meta.to_vec()),
    ];
    let bytes = zip(&parts, zip::CompressionMethod::Stored);
    let splats = parse(&bytes, Format::Sog).unwrap().splats;
    assert_eq!(splats.len(), 4);
    let near = |a: f32, b: f32| assert!((a - b).abs() < 1e-5, "{a} {b}");
    let e = 1f32.exp();
    for (a, b) in splats.means_m[3].to_array().into_iter().zip([0.0, 0.0, 1.0 - e * e]) {
        near(a, b);
    }
    for (a, b) in splats.scales_m[3].to_array().into_iter().zip([-5f32, 0.0, -4.0]) {
        near(a, b.exp());
    }
    // The tag selects y as the largest component.
    assert!(splats.rotations[3].y > 0.999);
    assert_eq!(splats.sh[..3], [-1.0, 0.4, 3.0]);
    near(splats.opacities[3], 1.0 / (1.0 + (-4f32).exp()));
}

/// Returns the glTF JSON of two splats with an embedded buffer, as other programs may write it:
/// quantised, in a nested node.
fn gltf_of_two(change: impl FnOnce(&mut serde_json::Value)) -> Vec<u8> {
    let mut bytes: Vec<u8> = Vec::new();
    for v in [1.0f32, 2.0, 3.0, -1.0, 0.5, 0.25] {
        bytes.extend(v.to_le_bytes());
    }
    // Rotations of 16 bits: identity, and half a turn about x; scales and opacities of 8 bits.
    for v in [0i16, 0, 0, 32767, -32767, 0, 0, 0] {
        bytes.extend(v.to_le_bytes());
    }
    bytes.extend([255, 51, 0, 0, 255, 255, 51, 0]);
    bytes.extend([255, 0, 51, 0]);
    for v in [0.1f32, 0.2, 0.3, 0.4, 0.5, 0.6] {
        bytes.extend(v.to_le_bytes());
    }
    let uri = format!("data:application/octet-stream;base64,{}", base64(&bytes));
    let view = |at: usize, length: usize| serde_json::json!({ "buffer": 0, "byteOffset": at, "byteLength": length });
    let own = |name: &str| format!("KHR_gaussian_splatting:{name}");
    let mut root = serde_json::json!({
        "asset": { "version": "2.0" },
        "scenes": [{ "nodes": [1] }],
        "nodes": [
            { "mesh": 0, "translation": [0.0, 0.0, 10.0], "scale": [2.0, 2.0, 2.0] },
            // Quarter turn about y.
            { "children": [0], "rotation": [0.0, 0.707_106_781_186_547_5, 0.0, 0.707_106_781_186_547_5] },
        ],
        "buffers": [{ "byteLength": bytes.len(), "uri": uri }],
        "bufferViews": [view(0, 24), view(24, 16), { "buffer": 0, "byteOffset": 40, "byteLength": 8, "byteStride": 4 }, { "buffer": 0, "byteOffset": 48, "byteLength": 4, "byteStride": 2 }, view(52, 24)],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 2, "type": "VEC3" },
            { "bufferView": 1, "componentType": 5122, "normalized": true, "count": 2, "type": "VEC4" },
            { "bufferView": 2, "componentType": 5121, "normalized": true, "count": 2, "type": "VEC3" },
            { "bufferView": 3, "componentType": 5121, "normalized": true, "count": 2, "type": "SCALAR" },
            { "bufferView": 4, "componentType": 5126, "count": 2, "type": "VEC3" },
        ],
        "meshes": [{ "primitives": [{
            "mode": 0,
            "attributes": {
                "POSITION": 0, own("ROTATION"): 1, own("SCALE"): 2, own("OPACITY"): 3,
                own("SH_DEGREE_0_COEF_0"): 4,
            },
            "extensions": { "KHR_gaussian_splatting": { "kernel": "ellipse", "colorSpace": "srgb_rec709_display" } },
        }] }],
    });
    change(&mut root);
    root.to_string().into_bytes()
}

fn base64(bytes: &[u8]) -> String {
    const SYMBOLS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let group = |three: &[u8]| -> String {
        let word = three.iter().fold(0u32, |word, &byte| word << 8 | u32::from(byte))
            << (8 * (3 - three.len()));
        (0..=three.len())
            .map(|k| char::from(SYMBOLS[(word >> (18 - 6 * k) & 63) as usize]))
            .collect()
    };
    bytes.chunks(3).map(group).collect()
}

#[test]
fn applies_the_transforms_of_gltf_nodes() {
    let splats = parse(&gltf_of_two(|_| ()), Format::Gltf).unwrap().splats;
    // Scaled by 2 and moved by 10 along z, then rotated about y: (x, y, z) to (z, y, -x); then x
    // and y change sign.
    let expected = [Vec3::new(-16.0, -4.0, -2.0), Vec3::new(-10.5, -1.0, 2.0)];
    for (mean_m, expected) in splats.means_m.iter().zip(expected) {
        assert!(mean_m.distance(expected) < 1e-5, "{mean_m} for {expected}");
    }
    assert!(
        (splats.scales_m[0] - Vec3::new(2.0, 0.4, 0.0)).length() < 1e-6,
        "{}",
        splats.scales_m[0]
    );
    // The quarter turn maps x to -z; the half turn about z keeps -z.
    let along = splats.rotations[0] * Vec3::X;
    assert!((along - Vec3::NEG_Z).length() < 1e-3, "{along}");
    assert!((splats.opacities[1] - 0.2).abs() < 1e-6);
    assert_eq!(splats.sh, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]);
}

fn splatting(root: &mut serde_json::Value) -> &mut serde_json::Value {
    &mut root["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
}

#[test]
fn names_unsupported_gltf_features() {
    let check = |change: fn(&mut serde_json::Value), part: &str| {
        let error = parse(&gltf_of_two(change), Format::Gltf).unwrap_err().to_string();
        assert!(error.contains(part), "{error:?} lacks {part:?}");
    };
    check(
        |v| v["extensionsRequired"] = serde_json::json!(["EXT_meshopt_compression"]),
        "EXT_meshopt_compression",
    );
    check(|v| splatting(v)["kernel"] = "cube".into(), "kernel \"cube\"");
    check(|v| splatting(v)["colorSpace"] = "lin_rec709_display".into(), "colour space");
    check(|v| splatting(v)["extensions"] = serde_json::json!({ "X_spz": {} }), "extension X_spz");
    check(
        |v| v["nodes"][0]["scale"] = serde_json::json!([1.0, 2.0, 1.0]),
        "scales axes differently",
    );
    check(|v| v["nodes"][0]["scale"] = serde_json::json!([-1.0, 1.0, 1.0]), "mirrors");
    check(|v| v["nodes"][0]["children"] = serde_json::json!([1]), "too many nodes");
    check(|v| v["accessors"][0]["count"] = 3.into(), "36 bytes from byte 0 on");
    check(|v| v["accessors"][0]["count"] = u64::MAX.into(), "bytes from byte 0 on");
    check(|v| v["accessors"][0]["bufferView"] = 99.into(), "no such bufferView");
    check(|v| v["accessors"][1]["type"] = "VEC3".into(), "type VEC3 instead of VEC4");
    check(|v| v["accessors"][3]["count"] = 1.into(), "different lengths");
    check(|v| v["buffers"][0]["byteLength"] = 1_000_000.into(), "truncated");
    check(|v| v["buffers"][0]["uri"] = "../../etc/passwd".into(), "not a plain file name");
    check(|v| v["buffers"][0]["uri"] = "beside.bin".into(), "save it as .glb");
    check(|v| drop(v.as_object_mut().unwrap().remove("meshes")), "no such mesh");
}

#[test]
fn reads_a_gltf_scene_with_its_buffer_in_another_file() {
    let folder = tempfile::tempdir().unwrap();
    let glb = gltf::encode(&some());
    let json_bytes = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let mut root: serde_json::Value = serde_json::from_slice(&glb[20..20 + json_bytes]).unwrap();
    root["buffers"][0]["uri"] = "scene.bin".into();
    std::fs::write(folder.path().join("scene.bin"), &glb[28 + json_bytes..]).unwrap();
    std::fs::write(folder.path().join("scene.gltf"), root.to_string()).unwrap();
    let loaded = read(folder.path().join("scene.gltf")).unwrap();
    assert_eq!(loaded, parse(&glb, Format::Gltf).unwrap());
    // A `.gltf` is not written, because its buffer would be in another file.
    let error = write(folder.path().join("out.gltf"), &some()).unwrap_err().to_string();
    assert!(error.contains("has no extension of a writable format"), "{error}");
}

#[test]
fn reads_antialiasing_from_ply_comments() {
    let check = |comments: &str, expected: bool| {
        let text = String::from_utf8_lossy(&ply::encode(&some())).into_owned();
        let start = text.find("element").unwrap();
        let mut bytes = ply::encode(&some());
        bytes.splice(start..start, comments.bytes());
        assert_eq!(parse(&bytes, Format::Ply).unwrap().splats.antialiased, expected, "{comments}");
    };
    check("", false);
    check("comment Exported from Brush\ncomment SplatRenderMode: mip\n", true);
    check("comment SplatRenderMode: default\n", false);
    check("comment splatrendermode:  MIP \n", true);
    check("comment antialiased 1\n", true);
    check("comment antialiased 0\n", false);
    check("comment antialiased maybe\ncomment not antialiased 1\n", false);
    check("comment antialiased 1\ncomment SplatRenderMode: default\n", false);
}

/// Returns the tree of two parts at two levels. One of its chunks holds both parts.
fn tree(change: impl FnOnce(&mut serde_json::Value)) -> Vec<u8> {
    let run = |file: usize, offset: usize, count: usize| serde_json::json!({ "file": file, "offset": offset, "count": count });
    let mut root = serde_json::json!({
        "version": 1, "lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"],
        "tree": { "children": [
            { "lods": { "0": run(0, 0, 3), "1": run(1, 0, 1) } },
            { "lods": { "0": run(0, 3, 4) } },
        ] },
    });
    change(&mut root);
    root.to_string().into_bytes()
}

fn streamed(index: &[u8], level: u32) -> Result<Loaded, FormatError> {
    assemble_streamed(index, level, |name| match name {
        "0_0/meta.json" => Ok(parse(&ply::encode(&some()), Format::Ply)?),
        "1_0/meta.json" => Ok(parse(&splat::encode(&some()), Format::Splat)?),
        _ => Err(FormatError::Unknown { what: name.to_owned() }),
    })
}

#[test]
fn assembles_a_level_of_a_streamed_scene() {
    let finest = streamed(&tree(|_| ()), 0).unwrap().splats;
    let known = parse(&ply::encode(&some()), Format::Ply).unwrap().splats;
    assert_eq!(finest, known);
    // A part without a second level keeps its finest level; missing harmonics of a chunk are zero.
    let coarse = streamed(&tree(|_| ()), 1).unwrap().splats;
    assert_eq!((coarse.len(), coarse.sh_degree), (5, 2));
    assert_eq!(coarse.means_m[..4], known.means_m[3..]);
    assert!(coarse.sh[4 * 27 + 3..].iter().all(|&v| v == 0.0));
    let around = streamed(&tree(|v| v["environment"] = "1_0/meta.json".into()), 0).unwrap();
    assert_eq!(around.splats.len(), 14);
    let check = |change: fn(&mut serde_json::Value), level: u32, part: &str| {
        let error = streamed(&tree(change), level).unwrap_err().to_string();
        assert!(error.contains(part), "{error:?} lacks {part:?}");
    };
    check(|_| (), 2, "no level 2; there are 0 to 1");
    check(|v| v["version"] = 2.into(), 0, "version 2");
    check(|v| v["tree"]["children"][0]["lods"]["0"]["file"] = 7.into(), 0, "no file 7");
    check(|v| v["tree"]["children"][0]["lods"]["0"]["offset"] = 6.into(), 0, "3 splats from 6 on");
    check(|v| v["tree"]["children"][0]["lods"]["0"]["offset"] = u64::MAX.into(), 0, "which has 7");
    check(
        |v| v["tree"]["children"][0]["lods"]["0"]["count"] = u64::MAX.into(),
        0,
        "number of splats",
    );
    check(|v| v["filenames"][0] = "elsewhere".into(), 0, "elsewhere");
    check(|v| v["tree"] = serde_json::json!({}), 0, "no splats");
}

#[test]
fn rejects_streamed_chunks_outside_the_scene_folder() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["../0_0/meta.json", "/etc/passwd", "a/../../b", "a\\b", "c:b", ""] {
        let index = tree(|v| v["filenames"][0] = name.into());
        std::fs::write(folder.path().join("lod-meta.json"), index).unwrap();
        let error = read(folder.path()).unwrap_err().to_string();
        assert!(error.contains("is not a file in the scene's folder"), "{name}: {error}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn returns_an_error_or_a_valid_scene_for_a_damaged_tree(
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4), level in 0..3u32,
    ) {
        let mut index = tree(|v| v["environment"] = "1_0/meta.json".into());
        for (at, byte) in damage {
            let at = at.index(index.len());
            index[at] = byte;
        }
        if let Ok(loaded) = streamed(&index, level) {
            check_sound(&loaded);
        }
    }

    #[test]
    fn returns_an_error_or_a_valid_scene_for_a_damaged_gltf(
        damage in prop::collection::vec((any::<prop::sample::Index>(), b' '..b'~'), 1..4),
    ) {
        let mut bytes = gltf_of_two(|_| ());
        for (at, byte) in damage {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        if let Ok(loaded) = parse(&bytes, Format::Gltf) {
            check_sound(&loaded);
        }
    }
}
