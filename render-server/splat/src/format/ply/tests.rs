use glam::{Quat, Vec3};
use proptest::prelude::*;

use super::{DropCounts, PlyError, encode, parse, read, write};
use crate::Splats;

/// Returns two splats of degree 1.
fn two() -> Splats {
    Splats {
        means_m: vec![Vec3::new(1.0, 2.0, 3.0), Vec3::new(-1.0, 0.5, 9.0)],
        scales_m: vec![Vec3::new(0.1, 0.2, 0.3), Vec3::splat(0.01)],
        rotations: vec![Quat::IDENTITY, Quat::from_xyzw(0.5, 0.5, 0.5, 0.5)],
        opacities: vec![0.25, 0.75],
        sh_degree: 1,
        sh: (0..24).map(|i| i as f32 * 0.125 - 1.0).collect(),
        antialiased: false,
    }
}

fn assert_close(a: &Splats, b: &Splats) {
    let near = |a: f32, b: f32| (a - b).abs() <= 1e-5 * a.abs().max(b.abs()) + 1e-7;
    assert_eq!((a.len(), a.sh_degree), (b.len(), b.sh_degree));
    assert_eq!(a.means_m, b.means_m);
    assert_eq!(a.sh, b.sh);
    for i in 0..a.len() {
        for k in 0..3 {
            assert!(near(a.scales_m[i][k], b.scales_m[i][k]), "{i}: {:?}", a.scales_m[i]);
        }
        assert!(a.rotations[i].abs_diff_eq(b.rotations[i], 1e-6));
        assert!(near(a.opacities[i], b.opacities[i]), "{} {}", a.opacities[i], b.opacities[i]);
    }
}

/// Returns the ascii file of `splats`, with the columns in reverse order if `reverse`.
fn ascii(splats: &Splats, reverse: bool) -> String {
    let binary = encode(splats);
    let text_end = binary.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&binary[..text_end]).unwrap();
    let mut names: Vec<&str> = header.lines().filter(|l| l.starts_with("property")).collect();
    let width = names.len();
    let mut rows: Vec<Vec<String>> = binary[text_end..]
        .chunks(width * 4)
        .map(|row| {
            row.chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()).to_string()).collect()
        })
        .collect();
    if reverse {
        names.reverse();
        for row in &mut rows {
            row.reverse();
        }
    }
    let rows: Vec<String> = rows.iter().map(|row| row.join(" ")).collect();
    format!(
        "ply\r\nformat ascii 1.0\r\ncomment hello\r\nelement vertex {}\r\n{}\r\nend_header\r\n{}\r\n",
        splats.len(),
        names.join("\r\n"),
        rows.join("\r\n")
    )
}

/// Returns a binary file of degree 0 with the given raw numbers in the order of `REQUIRED`.
fn raw(rows: &[[f32; 14]]) -> Vec<u8> {
    let names = super::layout::REQUIRED.map(|name| format!("property float {name}\n")).concat();
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\n{names}end_header\n",
        rows.len()
    )
    .into_bytes();
    bytes.extend(rows.iter().flatten().flat_map(|v| v.to_le_bytes()));
    bytes
}

const GOOD: [f32; 14] = [1.0, 2.0, 3.0, -2.0, -2.0, -2.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3];

/// Returns `GOOD` with the number at `slot` replaced.
fn with(slot: usize, value: f32) -> [f32; 14] {
    let mut row = GOOD;
    row[slot] = value;
    row
}

fn error(bytes: &[u8]) -> String {
    parse(bytes).expect_err("a bad file").to_string()
}

#[test]
fn reads_back_a_written_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.ply");
    write(&path, &two()).unwrap();
    let loaded = read(&path).unwrap();
    assert_close(&loaded.splats, &two());
    assert_eq!(loaded.dropped, DropCounts::default());
    assert_eq!(loaded.skipped_properties, ["nx", "ny", "nz"]);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no partial file stays");
}

#[test]
fn activates_raw_numbers() {
    let splats = parse(&raw(&[GOOD])).unwrap().splats;
    assert_eq!(splats.opacities, [0.5]);
    assert_eq!(splats.rotations, [Quat::IDENTITY]);
    assert!((splats.scales_m[0].x - (-2f32).exp()).abs() < 1e-7);
    assert_eq!(splats.sh, [0.1, 0.2, 0.3]);
}

#[test]
fn writes_harmonics_channel_major() {
    let splats = two();
    let bytes = encode(&splats);
    let body = bytes.len() - 2 * 26 * 4;
    let number =
        |i: usize| f32::from_le_bytes(bytes[body + i * 4..body + i * 4 + 4].try_into().unwrap());
    // x y z nx ny nz, 3 constants, then red of coefficients 1, 2, 3.
    assert_eq!([number(9), number(10), number(11)], [splats.sh[3], splats.sh[6], splats.sh[9]]);
}

#[test]
fn reads_ascii_in_any_column_order() {
    for reverse in [false, true] {
        assert_close(&parse(ascii(&two(), reverse).as_bytes()).unwrap().splats, &two());
    }
}

#[test]
fn skips_lists_and_other_elements_and_converts_other_types() {
    // A camera element with a list before the vertices, a face element after them; among the vertex
    // columns a list, a double, an opacity of type double, a red of type uchar.
    let mut bytes = b"ply\nformat binary_little_endian 1.0\nobj_info x\n\
        element camera 2\nproperty list uchar int views\nproperty short id\nelement vertex 2\n\
        property uchar red\n"
        .to_vec();
    for name in super::layout::REQUIRED {
        let kind = if name == "opacity" { "double" } else { "float" };
        bytes.extend(format!("property {kind} {name}\n").bytes());
        if name == "z" {
            bytes.extend(b"property list ushort float extra\n");
        }
    }
    bytes.extend(b"element face 1\nproperty list uchar int vertex_indices\nend_header\n");
    bytes.extend([1, 9, 0, 0, 0, 7, 0, 0, 7, 0]); // views [9], id 7; views [], id 7
    for items in [0u16, 2] {
        bytes.push(255);
        for (name, value) in super::layout::REQUIRED.iter().zip(GOOD) {
            if *name == "opacity" {
                bytes.extend(f64::from(value).to_le_bytes());
            } else {
                bytes.extend(value.to_le_bytes());
            }
            if *name == "z" {
                bytes.extend(items.to_le_bytes());
                bytes.extend(vec![0u8; usize::from(items) * 4]);
            }
        }
    }
    bytes.extend([3, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    let loaded = parse(&bytes).unwrap();
    let expected = parse(&raw(&[GOOD, GOOD])).unwrap().splats;
    assert_eq!(loaded.splats, expected);
    assert_eq!(loaded.skipped_properties, ["red", "extra"]);
    assert_eq!(loaded.skipped_elements, ["camera", "face"]);
}

#[test]
fn drops_and_counts_invalid_splats() {
    let rows = [
        with(0, f32::NAN),
        GOOD,
        with(4, f32::INFINITY),
        with(4, 200.0),
        with(6, 0.0),
        with(10, f32::NAN),
        with(12, f32::NEG_INFINITY),
        with(10, f32::INFINITY),
        with(10, f32::NEG_INFINITY),
        with(4, f32::NEG_INFINITY),
        with(6, 1e-30),
    ];
    let loaded = parse(&raw(&rows)).unwrap();
    assert_eq!(loaded.dropped, DropCounts { non_finite: 3, zero_rotation: 1, scale_overflow: 2 });
    assert_eq!(loaded.splats.opacities, [0.5, 1.0, 0.0, 0.5, 0.5]);
    assert_eq!(loaded.splats.scales_m[3].y, 0.0);
    assert_eq!(loaded.splats.rotations[4], Quat::IDENTITY);
    assert_eq!(loaded.splats.sh.len(), 5 * 3);
    assert!(error(&raw(&[with(6, 0.0)])).contains("declares 1, 1 of them were dropped"));
    assert!(error(&raw(&[])).contains("no splats: the file declares 0"));
}

#[test]
fn reports_position_and_cause_of_errors() {
    let check = |bytes: &[u8], part: &str| {
        let message = error(bytes);
        assert!(message.contains(part), "{message:?} lacks {part:?}");
    };
    check(b"", "not a PLY file");
    check(b"PK\x03\x04", "not a PLY file");
    check(b"ply\nformat ascii 1.0\n", "byte 21: no `end_header`");
    check(b"ply\nformat binary_big_endian 1.0\nend_header\n", "byte 4: format `binary_big_endian`");
    check(b"ply\nelement vertex 3\nend_header\n", "no `format`");
    check(b"ply\nformat ascii 1.0\nend_header\n", "no element `vertex`");
    check(b"ply\nformat ascii 1.0\nelement vertex -3\n", "count `-3`");
    check(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\n", "type `quad`");
    check(b"ply\nformat ascii 1.0\nproperty float x\n", "before any element");
    check(
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
          property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n",
        "lack `scale_0`",
    );
    let whole = String::from_utf8(raw(&[])).unwrap();
    let rest = whole.replace("end_header", "property float f_rest_0\nend_header");
    check(rest.as_bytes(), "1 f_rest properties; expected 0, 9, 24, 45 or 72");
    // A count beyond the memory of any computer is an error, not an allocation.
    for count in ["18446744073709551615", "4000000000"] {
        let huge = whole.replace("vertex 0", &format!("vertex {count}"));
        check(huge.as_bytes(), "truncated: element `vertex`");
        check(huge.replace("binary_little_endian", "ascii").as_bytes(), "truncated: element");
    }
    // The second row's y is 0.5.
    let text = ascii(&two(), false).replacen("-1 0.5 9", "-1 0,5 9", 1);
    check(text.as_bytes(), "row 1 of `vertex`: `y` is \"0,5\", not a number");
    check(
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar uchar x\nend_header\n",
        "lack",
    );
}

#[test]
fn rejects_a_file_truncated_anywhere() {
    let mut text = ascii(&two(), false).into_bytes();
    text.truncate(text.len() - 2);
    for bytes in [encode(&two()), text] {
        let is_ascii = bytes.windows(5).any(|w| w == b"ascii");
        // The last number of an ascii file remains a number if it loses digits.
        let end = if is_ascii { bytes.len() - 8 } else { bytes.len() };
        for length in 0..end {
            assert!(parse(&bytes[..length]).is_err(), "{length} of {} bytes", bytes.len());
        }
        assert!(parse(&bytes).is_ok());
    }
}

#[test]
fn names_a_missing_file() {
    let error = read("/nowhere/scene.ply").expect_err("no such file");
    assert!(matches!(error, PlyError::Io { .. }));
    assert!(error.to_string().contains("/nowhere/scene.ply"));
    assert!(matches!(read("/"), Err(PlyError::Io { .. })));
}

fn scene() -> impl Strategy<Value = Splats> {
    let splat = (
        prop::array::uniform3(-1e3..1e3f32),
        prop::array::uniform3(1e-6..10.0f32),
        prop::array::uniform4(-1.0..1.0f32),
        prop_oneof![0.0..=1.0f32, Just(0.0), Just(1.0)],
        prop::collection::vec(-3.0..3.0f32, 48),
    );
    (0..=3u8, prop::collection::vec(splat, 1..40)).prop_map(|(sh_degree, rows)| {
        let mut splats = Splats { sh_degree, ..Splats::default() };
        let numbers = splats.sh_coefficients() * 3;
        for (mean, scale, q, opacity, sh) in rows {
            let q = Quat::from_array(q);
            splats.means_m.push(mean.into());
            splats.scales_m.push(scale.into());
            let unit = if q.length() > 1e-2 { q.normalize() } else { Quat::IDENTITY };
            splats.rotations.push(unit);
            splats.opacities.push(opacity);
            splats.sh.extend(&sh[..numbers]);
        }
        splats
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn parses_an_encoded_scene_to_the_same_scene(splats in scene()) {
        assert_close(&parse(&encode(&splats)).unwrap().splats, &splats);
    }

    #[test]
    fn returns_an_error_or_a_finite_scene_for_damaged_bytes(
        splats in scene(), at in any::<prop::sample::Index>(), bytes in prop::array::uniform4(any::<u8>()),
    ) {
        let mut file = encode(&splats);
        let at = at.index(file.len() - 4);
        file[at..at + 4].copy_from_slice(&bytes);
        if let Ok(loaded) = parse(&file) {
            let s = &loaded.splats;
            prop_assert!(s.means_m.iter().chain(&s.scales_m).all(|v| v.is_finite()));
            prop_assert!(s.rotations.iter().all(|q| q.is_normalized()));
            prop_assert!(s.opacities.iter().all(|o| (0.0..=1.0).contains(o)));
            prop_assert!(s.sh.iter().all(|v| v.is_finite()));
        }
    }

    #[test]
    fn never_panics_on_text_after_the_magic(text in "ply\n(format ascii 1\\.0\n)?(element vertex [0-9]{1,20}\n|property (list )?(uchar|float|double) (x|y|int z)\n|comment .*\n){0,8}(end_header\n)?[ -~\n]{0,80}") {
        let _ = parse(text.as_bytes());
    }
}

/// Returns the file of `two` as a trainer writes it: with its comments and columns, all of type
/// float.
fn as_written_by(comments: &[&str], columns: &[String]) -> Vec<u8> {
    let binary = encode(&two());
    let text_end = binary.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&binary[..text_end]).unwrap();
    let names: Vec<&str> =
        header.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    let comments: String = comments.iter().flat_map(|text| ["comment ", text, "\n"]).collect();
    let properties: String =
        columns.iter().flat_map(|name| ["property float ", name, "\n"]).collect();
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\n{comments}element vertex 2\n{properties}end_header\n"
    )
    .into_bytes();
    for row in binary[text_end..].chunks(names.len() * 4) {
        for column in columns {
            match names.iter().position(|name| name == column) {
                Some(at) => bytes.extend_from_slice(&row[at * 4..at * 4 + 4]),
                // An additional column of the trainer.
                None => bytes.extend_from_slice(&7f32.to_le_bytes()),
            }
        }
    }
    bytes
}

/// Returns numbered names: `numbered("rot", 4)` is rot_0 to rot_3.
fn numbered(name: &str, count: usize) -> Vec<String> {
    (0..count).map(|i| format!("{name}_{i}")).collect()
}

#[test]
fn decodes_files_of_all_trainers_to_the_same_scene() {
    let names = |names: &[&str]| names.iter().map(ToString::to_string).collect::<Vec<_>>();
    let (xyz, normals) = (names(&["x", "y", "z"]), names(&["nx", "ny", "nz"]));
    let (dc, rest) = (numbered("f_dc", 3), numbered("f_rest", 9));
    let (scale, rotation) = (numbered("scale", 3), numbered("rot", 4));
    let opacity = names(&["opacity"]);
    let check = |comments: &[&str], groups: &[&Vec<String>], skipped: &[&str]| {
        let columns: Vec<String> = groups.iter().copied().flatten().cloned().collect();
        let loaded = parse(&as_written_by(comments, &columns)).unwrap();
        assert_close(&loaded.splats, &two());
        assert_eq!(loaded.skipped_properties, skipped, "{comments:?}");
    };
    let unused = ["nx", "ny", "nz"];
    // INRIA's trainer.
    check(&[], &[&xyz, &normals, &dc, &rest, &opacity, &scale, &rotation], &unused);
    // splatfacto: comments with program and up axis.
    check(
        &["Generated by Nerfstudio 1.1.5", "Vertical Axis: z"],
        &[&xyz, &normals, &dc, &rest, &opacity, &scale, &rotation],
        &unused,
    );
    // brush: no normals, scale and rotation before colour.
    check(
        &["Exported from Brush", "Vertical axis: y"],
        &[&xyz, &scale, &opacity, &rotation, &dc, &rest],
        &[],
    );
    // PostShot: INRIA's layout without normals.
    check(&[], &[&xyz, &dc, &rest, &opacity, &scale, &rotation], &[]);
    // Additional columns of editors such as SuperSplat.
    let own = names(&["state", "lod"]);
    check(&[], &[&own, &rotation, &opacity, &rest, &dc, &scale, &xyz], &["state", "lod"]);
}

#[test]
fn converts_byte_colours_to_the_constant_harmonic() {
    // splatfacto's `--ply-color-mode rgb`.
    let mut bytes = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n".to_vec();
    for name in &super::layout::REQUIRED[..11] {
        bytes.extend(format!("property float {name}\n").bytes());
    }
    for name in ["red", "green", "blue"] {
        bytes.extend(format!("property uchar {name}\n").bytes());
    }
    bytes.extend(b"end_header\n");
    bytes.extend(GOOD[..11].iter().flat_map(|v| v.to_le_bytes()));
    bytes.extend([0, 255, 51]);
    let splats = parse(&bytes).unwrap().splats;
    let c0 = crate::harmonics::C0 as f32;
    for (found, colour) in splats.sh.iter().zip([0.0, 1.0, 0.2f32]) {
        assert!((found * c0 + 0.5 - colour).abs() < 1e-6, "{found}");
    }
}

#[test]
fn reads_harmonics_of_degree_4_up_to_degree_3() {
    let mut names: Vec<String> = super::layout::REQUIRED.map(String::from).into();
    names.extend(numbered("f_rest", 72));
    let properties: String =
        names.iter().flat_map(|name| ["property float ", name, "\n"]).collect();
    let mut bytes =
        format!("ply\nformat binary_little_endian 1.0\nelement vertex 1\n{properties}end_header\n")
            .into_bytes();
    let rest = (0..72).map(|i| i as f32);
    bytes.extend(GOOD.into_iter().chain(rest).flat_map(f32::to_le_bytes));
    let loaded = parse(&bytes).unwrap();
    assert_eq!((loaded.splats.sh_degree, loaded.splats.sh.len()), (3, 48));
    // The file has 24 per channel; the first 15 are kept.
    assert_eq!(loaded.splats.sh[3..6], [0.0, 24.0, 48.0]);
    assert_eq!(loaded.splats.sh[45..], [14.0, 38.0, 62.0]);
    assert_eq!(loaded.skipped_properties.len(), 27);
}
