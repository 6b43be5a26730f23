//! Folder of a data set: paths of its files, requested settings, and completed images.
//!
//! ```text
//! dataset.json                                  settings; with the same settings, the data set is resumed
//! images/SPLIT/000000.png  depth/... flow/...   folder of each layer
//! records/SPLIT/000000.json                     last file of an image
//! ```
//! EuRoC's layout has `SCENE/mav0/cam0/data/NS.png`, `depth0` and others instead of `images/SPLIT`.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::record::ImageRecord;

/// A layer of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Layer {
    /// Colour, 8 bits per channel
    Rgb,
    /// Second colour image, at the time to which the optical flow leads
    Next,
    /// Depth along the optical axis in mm, 16-bit PNG; 0: no depth
    Depth,
    /// Surface normals in the camera's axes, encoded as 127.5 (n + 1)
    Normals,
    /// Ids of things, 16-bit PNG
    Instances,
    /// Classes, 8-bit PNG
    Classes,
    /// Optical flow, KITTI's 16-bit PNG
    Flow,
}

/// Layout of the data set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Format {
    /// COCO: boxes, masks as RLE, corners of gates (annotations/instances_train.json)
    Coco,
    /// YOLO boxes (labels/train/N.txt)
    Yolo,
    /// YOLO polygons (labels/train/N.txt)
    YoloSeg,
    /// YOLO gates with corners (labels/train/N.txt)
    YoloPose,
    /// EuRoC: SCENE/mav0 with cam0, depth0, state_groundtruth_estimate0
    Euroc,
}

/// Folder and layout of a data set.
#[derive(Clone, Debug)]
pub(super) struct Store {
    root: PathBuf,
    format: Format,
    jpeg: bool,
}

/// Data for the names of an image's files.
#[derive(Clone, Copy, Debug)]
pub(super) struct ImageName<'a> {
    pub(super) index: u64,
    pub(super) split: &'a str,
    pub(super) scene: &'a str,
    pub(super) at_ns: i64,
}

impl Store {
    /// Opens or creates the folder for the requested settings.
    ///
    /// # Errors
    /// The folder contains other files, or a data set with other settings.
    pub(super) fn open(root: &Path, format: Format, jpeg: bool, asked: &Value) -> Result<Self> {
        let path = root.join(ASKED);
        let text = serde_json::to_string_pretty(asked)? + "\n";
        // Compare numbers after a round trip, which may change the last bit.
        let asked: &Value = &serde_json::from_str(&text)?;
        match fs::read(&path) {
            Ok(bytes) => {
                let there: Value = serde_json::from_slice(&bytes)
                    .with_context(|| format!("{} is not of a data set", path.display()))?;
                if let Some(key) = difference(&there, asked) {
                    bail!(
                        "{} contains another data set: {key} is {}, but {} is requested; give another folder, or the same \
                         options",
                        root.display(),
                        at_key(&there, &key),
                        at_key(asked, &key)
                    );
                }
            }
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                let is_used = fs::read_dir(root).is_ok_and(|mut entries| entries.next().is_some());
                if is_used {
                    bail!(
                        "{} is not empty and has no {ASKED}; give another folder",
                        root.display()
                    );
                }
                write_whole(&path, text.as_bytes())?;
            }
            Err(error) => {
                return Err(error).with_context(|| format!("cannot read {}", path.display()));
            }
        }
        Ok(Self { root: root.to_owned(), format, jpeg })
    }

    pub(super) fn root(&self) -> &Path {
        &self.root
    }

    /// Returns the path of a layer of an image, relative to the data set's folder.
    pub(super) fn layer(&self, layer: Layer, name: &ImageName<'_>) -> String {
        let is_colour = matches!(layer, Layer::Rgb | Layer::Next);
        let ending = if is_colour && self.jpeg { "jpg" } else { "png" };
        let (folder, sensor) = match layer {
            Layer::Rgb => ("images", "cam0"),
            Layer::Next => ("next", "next0"),
            Layer::Depth => ("depth", "depth0"),
            Layer::Normals => ("normals", "normals0"),
            Layer::Instances => ("instances", "instances0"),
            Layer::Classes => ("classes", "classes0"),
            Layer::Flow => ("flow", "flow0"),
        };
        self.file(folder, sensor, name, ending)
    }

    /// Returns the path of an image's record, relative to the data set's folder.
    pub(super) fn record(&self, name: &ImageName<'_>) -> String {
        self.file("records", "records0", name, "json")
    }

    fn file(&self, folder: &str, sensor: &str, name: &ImageName<'_>, ending: &str) -> String {
        let ImageName { index, split, scene, at_ns } = name;
        match self.format {
            Format::Euroc => format!("{scene}/mav0/{sensor}/data/{at_ns}.{ending}"),
            _ => format!("{folder}/{split}/{index:06}.{ending}"),
        }
    }

    /// Whether an image is complete.
    pub(super) fn has(&self, name: &ImageName<'_>) -> bool {
        self.root.join(self.record(name)).is_file()
    }

    /// Writes a file of a layer, and creates its parent folders.
    pub(super) fn write(&self, file: &str, bytes: &[u8]) -> Result<()> {
        let path = self.root.join(file);
        let write = || fs::write(&path, bytes);
        write()
            .or_else(|error| {
                // The parent folder is missing for its first file.
                let above = path.parent().filter(|_| error.kind() == std::io::ErrorKind::NotFound);
                above.map_or(Err(error), fs::create_dir_all)?;
                write()
            })
            .with_context(|| format!("cannot write {}", path.display()))
    }

    /// Writes the record of an image, which marks it as complete.
    pub(super) fn finish(&self, name: &ImageName<'_>, record: &ImageRecord) -> Result<()> {
        write_whole(&self.root.join(self.record(name)), &serde_json::to_vec(record)?)
    }

    /// Reads the record of an image.
    ///
    /// # Errors
    /// The record does not exist, or is of another version.
    pub(super) fn read(&self, name: &ImageName<'_>) -> Result<ImageRecord> {
        let path = self.root.join(self.record(name));
        let context = || format!("cannot use {}; delete it, and run again", path.display());
        let bytes = fs::read(&path).with_context(context)?;
        serde_json::from_slice(&bytes).with_context(context)
    }
}

/// Writes a file atomically: under a temporary name, then renamed.
pub(super) fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let context = || format!("cannot write {}", path.display());
    if let Some(above) = path.parent() {
        fs::create_dir_all(above).with_context(context)?;
    }
    let part = path.with_added_extension(format!("{}.part", std::process::id()));
    fs::write(&part, bytes).with_context(context)?;
    fs::rename(&part, path).with_context(context)
}

/// Returns the first key with different values, such as `poses.tilt_deg`.
fn difference(there: &Value, asked: &Value) -> Option<String> {
    match (there, asked) {
        (Value::Object(a), Value::Object(b)) => {
            let keys = b.keys().chain(a.keys());
            keys.into_iter().find_map(|key| {
                let side = |map: &serde_json::Map<String, Value>| {
                    map.get(key).cloned().unwrap_or(Value::Null)
                };
                let (a, b) = (side(a), side(b));
                if a == b {
                    return None;
                }
                let within = difference(&a, &b).filter(|within| !within.is_empty());
                Some(within.map_or(key.clone(), |within| format!("{key}.{within}")))
            })
        }
        _ => (there != asked).then(String::new),
    }
}

fn at_key<'a>(value: &'a Value, key: &str) -> &'a Value {
    key.split('.').fold(value, |value, key| &value[key])
}

const ASKED: &str = "dataset.json";

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn accepts_only_the_same_data_set_in_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        let asked = json!({"seed": 1, "poses": {"tilt_deg": 10.0}});
        let root = folder.path().join("set");
        let store = Store::open(&root, Format::Coco, false, &asked).unwrap();
        assert_eq!(store.root(), root);
        Store::open(&root, Format::Coco, false, &asked).unwrap();
        let refused = |root: &Path, asked: &Value| {
            format!("{:#}", Store::open(root, Format::Coco, false, asked).unwrap_err())
        };
        let other = json!({"seed": 1, "poses": {"tilt_deg": 15.0}});
        let told = refused(&root, &other);
        assert!(told.contains("poses.tilt_deg is 10.0, but 15.0 is requested"), "{told}");
        let told = refused(&root, &json!({"seed": 1, "poses": {"tilt_deg": 10.0}, "val": 0.2}));
        assert!(told.contains("val is null, but 0.2 is requested"), "{told}");
        std::fs::write(folder.path().join("notes.txt"), "x").unwrap();
        assert!(refused(folder.path(), &asked).contains("is not empty"));
        std::fs::write(root.join(ASKED), "{").unwrap();
        assert!(refused(&root, &asked).contains("is not of a data set"));
    }

    #[test]
    fn paths_depend_on_format_and_layer() {
        let folder = tempfile::tempdir().unwrap();
        let name = ImageName { index: 12, split: "val", scene: "p3-7", at_ns: 300 };
        let store = |format, jpeg| {
            let root = folder.path().join(format!("{format:?}{jpeg}"));
            Store::open(&root, format, jpeg, &json!({})).unwrap()
        };
        let coco = store(Format::Coco, true);
        assert_eq!(coco.layer(Layer::Rgb, &name), "images/val/000012.jpg");
        assert_eq!(coco.layer(Layer::Flow, &name), "flow/val/000012.png");
        let euroc = store(Format::Euroc, false);
        assert_eq!(euroc.layer(Layer::Rgb, &name), "p3-7/mav0/cam0/data/300.png");
        assert_eq!(euroc.layer(Layer::Depth, &name), "p3-7/mav0/depth0/data/300.png");
        coco.write(&coco.layer(Layer::Depth, &name), b"x").unwrap();
        assert!(folder.path().join("Cocotrue/depth/val/000012.png").is_file());
        assert!(!coco.has(&name));
        assert!(format!("{:#}", coco.read(&name).unwrap_err()).contains("run again"));
    }
}
