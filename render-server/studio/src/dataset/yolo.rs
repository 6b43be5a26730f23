//! YOLO labels as documented by Ultralytics: `labels/SPLIT/N.txt` next to `images/SPLIT`, and `data.yaml`.
//!
//! Positions are relative to the image's width and height, from its upper left corner. Boxes: `class x y w h` with the
//! centre. Polygons: `class x1 y1 x2 y2 ...`, with holes joined by seams. Gates: a box and `x y v` of each corner.

use std::fmt::Write;

use anyhow::{Context, Result};

use super::Labelled;
use super::outline::outline;
use super::record::{GateRecord, ImageRecord, ThingRecord};
use super::store::{Format, Store, write_whole};
use crate::labels::rle;

/// Writes the labels of these splits and `data.yaml`.
pub(super) fn write(
    store: &Store,
    labelled: &Labelled<'_>,
    format: Format,
    splits: &[&str],
) -> Result<()> {
    for split in splits {
        for record in labelled.records(store, split) {
            let record = record?;
            let path = format!("labels/{split}/{:06}.txt", record.index);
            store.write(&path, labels(labelled, format, &record)?.as_bytes())?;
        }
    }
    let yaml = data(labelled, format, splits);
    write_whole(&store.root().join("data.yaml"), yaml.as_bytes())
}

fn labels(labelled: &Labelled<'_>, format: Format, record: &ImageRecord) -> Result<String> {
    let mut text = String::new();
    for (class, thing) in labelled.annotated(record) {
        match format {
            Format::YoloSeg => polygon(&mut text, class, record, thing)?,
            Format::YoloPose => {
                let gate = record.gates.iter().find(|gate| gate.id == thing.id);
                if let Some(gate) = gate.filter(|_| thing.class == GATE) {
                    corners(&mut text, record, thing, gate);
                }
            }
            _ => {
                let _ = writeln!(text, "{class} {}", middle(record, thing));
            }
        }
    }
    Ok(text)
}

fn size(record: &ImageRecord) -> [f64; 2] {
    [f64::from(record.camera.width_px), f64::from(record.camera.height_px)]
}

fn middle(record: &ImageRecord, thing: &ThingRecord) -> String {
    let [width, height] = size(record);
    let [x, y, w, h] = thing.box_px.map(f64::from);
    let (x, y) = ((x + w / 2.0) / width, (y + h / 2.0) / height);
    format!("{x:.6} {y:.6} {:.6} {:.6}", w / width, h / height)
}

fn polygon(
    text: &mut String,
    class: usize,
    record: &ImageRecord,
    thing: &ThingRecord,
) -> Result<()> {
    let [width, height] = size(record);
    let pixels = [record.camera.width_px as usize, record.camera.height_px as usize];
    let mask = rle::from_text(&thing.rle).and_then(|counts| rle::to_pixels(&counts, pixels));
    let mask = mask.with_context(|| {
        format!("the mask of {} in the record of image {} is invalid", thing.name, record.index)
    })?;
    let _ = write!(text, "{class}");
    for [x, y] in outline(&mask, pixels) {
        let _ = write!(text, " {:.6} {:.6}", f64::from(x) / width, f64::from(y) / height);
    }
    text.push('\n');
    Ok(())
}

fn corners(text: &mut String, record: &ImageRecord, thing: &ThingRecord, gate: &GateRecord) {
    let [width, height] = size(record);
    let _ = write!(text, "0 {}", middle(record, thing));
    for corner in &gate.corners {
        let [x, y] = corner.at_px;
        let _ = match corner.visibility {
            0 => write!(text, " 0 0 0"),
            seen => write!(text, " {:.6} {:.6} {seen}", x / width, y / height),
        };
    }
    text.push('\n');
}

fn data(labelled: &Labelled<'_>, format: Format, splits: &[&str]) -> String {
    let mut yaml = "# Relative to this file.\ntrain: images/train\n".to_owned();
    let val = if splits.contains(&"val") { "val" } else { "train" };
    let _ = writeln!(yaml, "val: images/{val}");
    if format == Format::YoloPose {
        yaml += "kpt_shape: [4, 3]\n# Upper left, upper right, lower right, lower left, in a mirrored image.\nflip_idx: [1, 0, 3, 2]\n";
    }
    yaml += "names:\n";
    let gate = [GATE.to_owned()];
    let names = if format == Format::YoloPose { &gate[..] } else { &labelled.things[..] };
    for (n, name) in names.iter().enumerate() {
        let _ = writeln!(yaml, "  {n}: {name}");
    }
    yaml
}

const GATE: &str = "gate";
