//! Lists of edits, and scenes edited with them.

use glam::{Quat, Vec3};
use proptest::prelude::*;
use vizflyt_splat::edit::{Axis, Carve, Region};
use vizflyt_splat::ply;

use super::*;

fn row(count: usize) -> Splats {
    Splats {
        means_m: (0..count).map(|k| Vec3::new(k as f32, 0.0, 0.0)).collect(),
        scales_m: vec![Vec3::splat(0.1); count],
        rotations: vec![Quat::IDENTITY; count],
        opacities: (0..count).map(|k| 0.1 + 0.8 * k as f32 / count as f32).collect(),
        sh_degree: 0,
        sh: vec![0.5; count * 3],
        antialiased: false,
    }
}

fn box_to(x: f64) -> Vec<Region> {
    vec![Region::Box { min: [-1.0; 3], max: [x, 1.0, 1.0] }]
}

#[test]
fn edits_are_applied_listed_and_undone() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("row.ply");
    ply::write(&scene, &row(100)).unwrap();
    let before = std::fs::read(&scene).unwrap();
    let result = result_path(&scene);
    assert_eq!(result, folder.path().join("row.edited.ply"));

    let mut editor = Editor::open(&scene).unwrap();
    assert_eq!(editor.apply(EditStep::Crop { within: box_to(49.5) }).unwrap(), 50);
    assert!(editor.apply(EditStep::Crop { within: box_to(-0.5) }).is_err());
    assert_eq!(editor.apply(EditStep::Remove { within: box_to(9.5) }).unwrap(), 10);
    editor.save(&result).unwrap();
    let edited = std::fs::read(&result).unwrap();
    assert_eq!(format::read(&result).unwrap().splats.len(), 40);

    // Original and list give the same result again.
    std::fs::remove_file(&result).unwrap();
    let again = Editor::open(&scene).unwrap();
    let taken: Vec<usize> = again.steps().iter().map(|step| step.taken).collect();
    assert_eq!(taken, [50, 10]);
    again.save(&result).unwrap();
    assert!(std::fs::read(&result).unwrap() == edited);

    let mut back = Editor::open_without_last(&scene, 1).unwrap();
    assert_eq!((back.splats().len(), back.steps().len()), (50, 1));
    assert_eq!(back.undo().unwrap(), EditStep::Crop { within: box_to(49.5) });
    assert_eq!(back.splats().len(), 100);
    assert!(back.undo().unwrap_err().to_string().contains("nothing to undo"));
    back.save(&result).unwrap();
    let error = Editor::open_without_last(&scene, 1).unwrap_err();
    assert!(error.to_string().contains("nothing to undo"), "{error}");
    assert!(std::fs::read(&scene).unwrap() == before);
    let error = back.save(&folder.path().join(".").join("row.ply")).unwrap_err();
    assert!(error.to_string().contains("the original"), "{error}");
}

#[test]
fn a_list_belongs_to_one_file() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let check = |path: &Path, expected: &str| {
        let error = format!("{:#}", Editor::open(path).unwrap_err());
        assert!(error.contains(expected), "'{error}' lacks '{expected}'");
    };
    ply::write(at("row.ply"), &row(9)).unwrap();
    let mut editor = Editor::open(&at("row.ply")).unwrap();
    editor.apply(EditStep::Decimate { count: 5 }).unwrap();
    editor.save(&at("out.splat")).unwrap();
    ply::write(at("row.ply"), &row(10)).unwrap();
    check(&at("row.ply"), "put the original back");
    assert!(editor.undo().unwrap_err().to_string().contains("changed since it was opened"));
    ply::write(at("other.ply"), &row(9)).unwrap();
    std::fs::copy(at("row.ply.edits.toml"), at("other.ply.edits.toml")).unwrap();
    check(&at("other.ply"), "lists edits of row.ply");
    std::fs::write(at("other.ply.edits.toml"), "scene = 3").unwrap();
    check(&at("other.ply"), "other.ply.edits.toml is wrong");
    check(&at("none.ply"), "none.ply");
    std::fs::create_dir(at("folder")).unwrap();
    check(&at("folder"), "scene convert");
}

#[test]
fn results_are_named_after_their_originals() {
    let check = |from: &str, to: &str| assert_eq!(result_path(Path::new(from)), Path::new(to));
    check("a/room.ply", "a/room.edited.ply");
    check("room.compressed.ply", "room.edited.compressed.ply");
    check("room.spz", "room.edited.spz");
    check("room.gltf", "room.gltf.edited.glb");
    check("room", "room.edited.ply");
    assert_eq!(list_path(Path::new("a/room.spz")), Path::new("a/room.spz.edits.toml"));
}

#[test]
fn names_errors_of_a_list() {
    let scene = format!("[scene]\nfile = \"a.ply\"\nsha256 = \"{}\"\nsplats = 9\n", "0".repeat(64));
    let check = |steps: &str, expected: &str| {
        let error = EditList::parse(&format!("{scene}{steps}")).unwrap_err().to_string();
        assert!(error.contains(expected), "'{error}' lacks '{expected}'");
    };
    assert_eq!(EditList::parse(&scene).unwrap().steps, []);
    check("[[steps]]\ntaken = 1\nedit.faint.below = 2\n", "step 1: below = 2");
    check("[[steps]]\ntaken = 1\nedit.faint.bellow = 0.1\n", "available keys: below");
    check("[[steps]]\ntaken = -1\nedit.faint.below = 0.1\n", "line 6");
    check("[[steps]]\ntaken = 1\nedit.vanish = 0.1\n", "vanish");
    check("[[step]]\n", "did you mean 'steps'");
    check(&"[[steps]]\ntaken = 1\nedit.faint.below = 0.1\n".repeat(1001), "at most");
    let error = EditList::parse(&scene.replace("000", "xyz")).unwrap_err();
    assert!(matches!(error, EditListError::Hash(_)), "{error}");
}

fn step() -> impl Strategy<Value = EditStep> {
    let length = || 1e-3..1e3f64;
    let point = || prop::array::uniform3(-1e3..1e3f64);
    let outline = || prop::collection::vec(prop::array::uniform2(-9.0..9.0f64), 3..9);
    let region = prop_oneof![
        (point(), length()).prop_map(|(center, radius)| Region::Sphere { center, radius }),
        point().prop_map(|min| Region::Box { min, max: min.map(|v| v + 1.0) }),
        outline().prop_map(|outline| Region::Prism { axis: Axis::Y, outline, low: 0.0, high: 1.0 }),
        (point(), outline(), any::<bool>()).prop_map(|(eye, outline, visible)| Region::View {
            eye,
            rotation: [0.0, 0.6, 0.0, 0.8],
            outline,
            visible,
        }),
    ];
    prop_oneof![
        prop::collection::vec(region, 1..4).prop_map(|within| EditStep::Crop { within }),
        (0.0..1.0f64).prop_map(|below| EditStep::Faint { below }),
        (length(), 1..99u32).prop_map(|(cell, least)| EditStep::Floaters { cell, least }),
        (prop::collection::vec(point(), 1..4), length()).prop_map(|(path, radius)| {
            EditStep::Carve(Carve { path, radius, depth: 0.1, cell: 0.1, reach: 9.0 })
        }),
        (1..u32::MAX).prop_map(|count| EditStep::Decimate { count }),
        point().prop_map(|by| EditStep::Move { by }),
        Just(EditStep::Turn { rotation: [0.5; 4] }),
    ]
}

proptest! {
    /// Written lists are read back exactly.
    #[test]
    fn lists_are_read_as_they_were_written(
        steps in prop::collection::vec((0..99_999usize, step()), 0..9), file in ".{1,12}",
    ) {
        let mut list = EditList::new(file, "0123456789abcdef".repeat(4), 3);
        list.steps = steps.into_iter().map(|(taken, edit)| DoneStep { taken, edit }).collect();
        prop_assert_eq!(EditList::parse(&list.to_toml()), Ok(list));
    }

    /// Texts with some of a list's words: an error or a list, without a panic.
    #[test]
    fn any_text_is_a_list_or_an_error(text in "(\\[\\[?(scene|steps)\\]\\]?|edit|faint|=|[0-9.]|\n|\\{|\\}){0,40}") {
        let _ = EditList::parse(&text);
    }
}
