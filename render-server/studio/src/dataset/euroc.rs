//! EuRoC layout of each scene: `SCENE/mav0/cam0`, `depth0` and the other layers, and the true poses of the camera.
//!
//! The body frame has the camera at its origin: x forward, y left, z up.

use std::collections::BTreeMap;

use anyhow::Result;
use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Pose, World as WorldFrame, body_from_forward_cam};

use super::Labelled;
use super::record::ImageRecord;
use super::store::{Layer, Store, write_whole};
use crate::export::euroc::{TruthRow, camera_yaml, images_csv, truth_csv, truth_yaml};

/// Writes lists, sensors and truth of all scenes.
pub(super) fn write(store: &Store, labelled: &Labelled<'_>, layers: &[Layer]) -> Result<()> {
    let mut scenes: BTreeMap<String, Vec<ImageRecord>> = BTreeMap::new();
    for record in labelled.records(store, "train") {
        let mut record = record?;
        record.things.clear();
        scenes.entry(record.scene.clone()).or_default().push(record);
    }
    for (scene, records) in scenes {
        let stamps: Vec<u64> = records.iter().map(|record| record.at_ns.unsigned_abs()).collect();
        let Some(first) = records.first() else { continue };
        let body_from_cam = body_from_forward_cam(DVec3::ZERO, 0.0);
        for &layer in layers {
            // `p3-7/mav0/depth0`
            let file = store.layer(layer, &first.name());
            let Some((folder, name)) = file.split_once("/data/") else { continue };
            let ending = name.rsplit('.').next().unwrap_or("png");
            let root = store.root().join(folder);
            write_whole(&root.join("data.csv"), images_csv(&stamps, ending).as_bytes())?;
            let k = first.camera.intrinsics();
            let yaml = camera_yaml("rendered", &k, &body_from_cam, &stamps);
            write_whole(&root.join("sensor.yaml"), yaml.as_bytes())?;
        }
        let rows = records.iter().map(|record| {
            let world_from_body: Pose<WorldFrame, Body> =
                record.world_from_cam.world_from_cam() * body_from_cam.inverse();
            TruthRow {
                at_ns: record.at_ns.unsigned_abs(),
                world_from_body,
                v_world_mps: velocity_mps(record),
            }
        });
        let root = store.root().join(scene).join("mav0/state_groundtruth_estimate0");
        write_whole(&root.join("data.csv"), truth_csv(rows).as_bytes())?;
        let yaml = truth_yaml("true pose of the body, with the camera at its origin, in the world");
        write_whole(&root.join("sensor.yaml"), yaml.as_bytes())?;
    }
    Ok(())
}

/// Returns the mean velocity to the next camera pose; 0 if there is none. [m/s, world]
fn velocity_mps(record: &ImageRecord) -> DVec3 {
    record.next.map_or(DVec3::ZERO, |next| {
        let way_m = DVec3::from(next.world_from_cam.p_m) - DVec3::from(record.world_from_cam.p_m);
        way_m / (((next.at_ns - record.at_ns) as f64) * 1e-9).max(1e-9)
    })
}
