//! `vizflyt dataset`: shards, interruptions and threads do not change any byte, and errors name the cause.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use vizflyt_e2e::{check_refused, good, root};

/// Returns all files of a folder by relative name.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().to_owned();
                found.insert(name, fs::read(&path).unwrap());
            }
        }
    }
    found
}

struct Rig(tempfile::TempDir);

impl Rig {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn at(&self, name: &str) -> String {
        self.0.path().join(name).to_str().unwrap().to_owned()
    }

    /// Renders twelve small images of two courses.
    fn render(&self, name: &str, more: &[&str]) -> BTreeMap<PathBuf, Vec<u8>> {
        let (folder, how) = (self.at(name), root().join("docs/guides/randomize.toml"));
        let how = how.to_str().unwrap();
        let common =
            ["dataset", "--project", "p5", "--seeds", "2", "--images", "12", "--size", "96x72"];
        good(&[&common[..], &["--randomize", how, "-o", &folder], more].concat());
        files(Path::new(&folder))
    }
}

#[test]
fn shards_interruptions_and_threads_do_not_change_any_byte() {
    let rig = Rig::new();
    let whole = rig.render("whole", &["--threads", "2"]);
    for name in ["images/train/000000.png", "flow/val/000011.png", "annotations/instances_val.json"]
    {
        assert!(whole.contains_key(Path::new(name)), "{name} is not in {:?}", whole.keys());
    }
    // 7 layers except `next`, and the record.
    assert_eq!(whole.len(), 12 * 7 + 2 + 1);

    let first = rig.render("parts", &["--shard", "1/3", "--threads", "1"]);
    assert_eq!(first.len(), 4 * 7 + 1, "{:?}", first.keys());
    rig.render("parts", &["--shard", "3/3"]);
    let parts = rig.render("parts", &["--shard", "2/3"]);
    assert_eq!(parts, whole);

    // An image without its record, or a damaged one, is rendered again.
    let folder = PathBuf::from(rig.at("parts"));
    for name in
        ["records/train/000003.json", "depth/train/000003.png", "annotations/instances_val.json"]
    {
        fs::remove_file(folder.join(name)).unwrap();
    }
    fs::write(folder.join("images/train/000003.png"), "half").unwrap();
    assert_eq!(rig.render("parts", &[]), whole);
}

#[test]
fn annotations_match_the_images() {
    let rig = Rig::new();
    let sheet = rig.at("sheet.jpg");
    let whole = rig.render("set", &["--things", "gate,moving,distractor", "--sheet", &sheet]);
    assert_eq!(fs::read(sheet).unwrap()[..2], [0xff, 0xd8]);
    let json = |name: &str| -> Value {
        serde_json::from_slice(&whole[Path::new(name)])
            .unwrap_or_else(|error| panic!("{name}: {error}"))
    };
    let train = json("annotations/instances_train.json");
    assert_eq!(train["images"].as_array().unwrap().len(), 6);
    let names: Vec<&str> = train["categories"]
        .as_array()
        .unwrap()
        .iter()
        .map(|one| one["name"].as_str().unwrap())
        .collect();
    assert_eq!(names, ["gate", "moving", "distractor"]);
    let annotations = train["annotations"].as_array().unwrap();
    let gates = annotations.iter().filter(|one| one["category_id"] == 1);
    assert!(gates.clone().count() >= 3, "{annotations:?}");
    assert!(gates.clone().all(|one| one["keypoints"].as_array().unwrap().len() == 12));
    let record = json("records/train/000000.json");
    assert_eq!((&record["scene"], &record["seed"]), (&"p5-1".into(), &1.into()));
    assert_eq!(record["camera"]["width_px"], 96);
}

#[test]
fn writes_other_formats_along_a_path_in_a_scene_file() {
    let rig = Rig::new();
    good(&["scene", "generate", "race", "--seed", "4", "-o", &rig.at("race")]);
    let path = rig.at("path.tum");
    let row = |n: u8| format!("{n}.5 {} 0 1.2 0 0 0 1\n", 0.5 + 0.1 * f64::from(n));
    let rows = (0..5).map(row).collect::<Vec<_>>().concat();
    fs::write(&path, rows).unwrap();
    let parts = rig.at("parts.toml");
    fs::write(&parts, "[[parts]]\nname = \"floor\"\nclass = \"mat\"\ncenter_m = [5, 0, 0]\nsize_m = [30, 30, 0.1]\n").unwrap();
    let render = |format: &str, more: &[&str]| {
        let (scene, out) = (rig.at("race"), rig.at(format));
        let common =
            ["dataset", "--scene", &scene, "--path", &path, "--parts", &parts, "--size", "64x48"];
        good(&[&common[..], &["--format", format, "-o", &out], more].concat());
        files(Path::new(&out))
    };
    let euroc = render("euroc", &[]);
    let text = |set: &BTreeMap<PathBuf, Vec<u8>>, name: &str| {
        String::from_utf8(set[Path::new(name)].clone()).unwrap()
    };
    let list = text(&euroc, "scene-1/mav0/cam0/data.csv");
    assert_eq!(list.lines().nth(2), Some("1000000000,1000000000.png"));
    assert!(euroc.contains_key(Path::new("scene-1/mav0/depth0/data/4000000000.png")));
    let truth = text(&euroc, "scene-1/mav0/state_groundtruth_estimate0/data.csv");
    let row: Vec<f64> =
        truth.lines().nth(2).unwrap().split(',').map(|cell| cell.parse().unwrap()).collect();
    // Pose of the path, upright, at 0.1 m/s along x.
    for (found, expected) in row[1..].iter().zip([0.6, 0.0, 1.2, 1.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
    {
        assert!((found - expected).abs() < 1e-9, "{truth}");
    }
    let yolo = render("yolo", &["--val", "0.4", "--jpeg", "90"]);
    assert_eq!(text(&yolo, "data.yaml").lines().nth(2), Some("val: images/val"));
    assert!(yolo.contains_key(Path::new("images/val/000004.jpg")));
    let label = text(&yolo, "labels/train/000000.txt");
    let numbers: Vec<f64> = label.split_whitespace().map(|cell| cell.parse().unwrap()).collect();
    assert!(
        numbers.len() >= 5 && numbers[1..5].iter().all(|share| (0.0..=1.0).contains(share)),
        "{label}"
    );
}

#[test]
fn errors_name_the_cause() {
    let rig = Rig::new();
    let out = rig.at("out");
    let refused = |more: &[&str], told: &[&str]| {
        check_refused(&[&["dataset", "--project", "p3", "-o", &out], more].concat(), told);
    };
    refused(&["--fov", "200"], &["--fov 200", "10 to 150"]);
    refused(&["--layers", "depth"], &["must include rgb"]);
    refused(&["--things", "gates"], &["unknown class", "gate, vehicle"]);
    refused(&["--seeds", "9", "--images", "3"], &["9 courses"]);
    refused(&["--gate-distance", "5..1"], &["0.8..5"]);
    refused(&["--path", "nowhere.tum"], &["nowhere.tum"]);
    refused(&["--images", "2", "--clearance", "2"], &["positions has a clearance", "--clearance"]);
    let how = rig.at("how.toml");
    fs::write(&how, "[fog]\nprobability = 2\n").unwrap();
    refused(&["--randomize", &how], &["how.toml", "fog.probability = 2"]);
    check_refused(&["dataset", "--project", "p9", "-o", &out], &["no project 'p9'"]);
    check_refused(&["dataset", "-o", &out], &["--project <NAME>|--scene <PATH>"]);
    good(&["dataset", "--project", "p3", "-o", &rig.at("set"), "--images", "2", "--size", "32x24"]);
    let again =
        ["dataset", "--project", "p3", "-o", &rig.at("set"), "--images", "3", "--size", "32x24"];
    check_refused(&again, &["contains another data set", "images is 2", "3 is requested"]);
}
