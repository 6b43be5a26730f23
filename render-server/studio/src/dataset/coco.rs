//! COCO's annotations (Lin et al. 2014; cocodataset.org, "Data format"): `annotations/instances_SPLIT.json`.
//!
//! Each class of things is a category. Masks are compressed RLE, which can store holes. Keypoints of a gate are its
//! corners. Additional keys: `world_from_cam` and `camera` of an image, `cam_from_gate` of a gate's annotation.

use std::fs;
use std::io::{BufWriter, Write};

use anyhow::{Context, Result};
use serde_json::{Value, json};

use super::Labelled;
use super::record::{ImageRecord, ThingRecord};
use super::store::{Layer, Store};

/// Writes the annotations of a split, record by record.
pub(super) fn write(store: &Store, labelled: &Labelled<'_>, split: &str) -> Result<()> {
    let path = store.root().join(format!("annotations/instances_{split}.json"));
    let context = || format!("cannot write {}", path.display());
    fs::create_dir_all(store.root().join("annotations")).with_context(context)?;
    let part = path.with_added_extension(format!("{}.part", std::process::id()));
    let mut out = BufWriter::new(fs::File::create(&part).with_context(context)?);
    let info =
        json!({"description": "rendered by vizflyt dataset", "version": env!("CARGO_PKG_VERSION")});
    write!(out, "{{\"info\":{info},\"licenses\":[],\"categories\":").with_context(context)?;
    serde_json::to_writer(&mut out, &categories(&labelled.things))?;
    write!(out, ",\n\"images\":[").with_context(context)?;
    let mut separator = "\n";
    for record in labelled.records(store, split) {
        let record = record?;
        write!(out, "{separator}{}", image(store, &record)).with_context(context)?;
        separator = ",\n";
    }
    write!(out, "],\n\"annotations\":[").with_context(context)?;
    let (mut separator, mut id) = ("\n", 0u64);
    for record in labelled.records(store, split) {
        let record = record?;
        for (category, thing) in labelled.annotated(&record) {
            id += 1;
            let annotation = annotation(id, category, &record, thing);
            write!(out, "{separator}{annotation}").with_context(context)?;
            separator = ",\n";
        }
    }
    writeln!(out, "]}}").with_context(context)?;
    out.into_inner().map_err(std::io::IntoInnerError::into_error).with_context(context)?;
    fs::rename(&part, &path).with_context(context)
}

fn categories(things: &[String]) -> Value {
    let category = |(n, name): (usize, &String)| {
        let mut category = json!({"id": n + 1, "name": name, "supercategory": "thing"});
        if name == GATE {
            category["keypoints"] =
                json!(["upper_left", "upper_right", "lower_right", "lower_left"]);
            category["skeleton"] = json!([[1, 2], [2, 3], [3, 4], [4, 1]]);
        }
        category
    };
    things.iter().enumerate().map(category).collect()
}

fn image(store: &Store, record: &ImageRecord) -> Value {
    let file = store.layer(Layer::Rgb, &record.name());
    // File names are relative to `images/SPLIT`.
    let file = file.rsplit('/').next().unwrap_or(&file);
    json!({
        "id": record.index + 1,
        "file_name": file,
        "width": record.camera.width_px,
        "height": record.camera.height_px,
        "scene": record.scene,
        "camera": record.camera,
        "world_from_cam": record.world_from_cam,
    })
}

fn annotation(id: u64, category: usize, record: &ImageRecord, thing: &ThingRecord) -> Value {
    let mut annotation = json!({
        "id": id,
        "image_id": record.index + 1,
        "category_id": category + 1,
        "iscrowd": 0,
        "area": thing.area_px,
        "bbox": thing.box_px,
        "segmentation": {"size": [record.camera.height_px, record.camera.width_px], "counts": thing.rle},
        "name": thing.name,
        "instance": thing.id,
    });
    if thing.class == GATE
        && let Some(gate) = record.gates.iter().find(|gate| gate.id == thing.id)
    {
        let point = |corner: &super::record::CornerRecord| match corner.visibility {
            0 => [json!(0), json!(0), json!(0)],
            visibility => [json!(corner.at_px[0]), json!(corner.at_px[1]), json!(visibility)],
        };
        let points: Vec<Value> = gate.corners.iter().flat_map(point).collect();
        let count = gate.corners.iter().filter(|corner| corner.visibility > 0).count();
        annotation["keypoints"] = points.into();
        annotation["num_keypoints"] = count.into();
        annotation["cam_from_gate"] = json!(gate.cam_from_gate);
    }
    annotation
}

const GATE: &str = "gate";
