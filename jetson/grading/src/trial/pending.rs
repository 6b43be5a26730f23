//! Images on their way to the plugin.

use sha2::{Digest, Sha256};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::messages::CameraInfo;
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_runtime::log::GivenImage;
use zerocopy::IntoBytes as _;

pub(super) struct Pending {
    /// Time of delivery to the plugin.
    pub(super) due: HostTime,
    pub(super) seq: u64,
    /// Stamp of the newest pose that the image is based on.
    pub(super) pose: ServerTime,
    /// Instant that the image shows.
    pub(super) shown: ServerTime,
    /// Predicted pose of the vehicle at that instant.
    pub(super) world_from_body: Pose<World, Body>,
    /// Images by camera; `None` if the camera was not due.
    pub(super) rendered: Vec<Option<Picture>>,
}

/// Image of one camera for the plugin.
#[derive(Debug, Default)]
pub(super) struct Picture {
    pub(super) rgb: Vec<u8>,
    pub(super) depth_mm: Vec<u16>,
    /// Clearance ahead, for the report; also known if the plugin gets no depth. [m, cam]
    pub(super) ahead_m: Option<f64>,
}

impl Picture {
    pub(super) fn add_to(&self, hash: &mut Sha256) {
        hash.update(&self.rgb);
        // Little-endian, so that the hash is the same on every computer.
        const { assert!(cfg!(target_endian = "little")) };
        hash.update(self.depth_mm.as_bytes());
    }
}

impl Pending {
    /// Returns the header of each camera's image, for the log.
    pub(super) fn headers(&self, cameras: &[CameraInfo]) -> Vec<ImageHeader> {
        let header = |(index, camera): (usize, &CameraInfo)| {
            let CameraInfo { intrinsics, body_from_cam, .. } = camera;
            let camera = index as u8;
            let of = (intrinsics, body_from_cam, &self.world_from_body);
            let mut header = ImageHeader::new(self.seq, camera, self.pose, of.0, of.1, of.2);
            header.exposure_ns = self.shown.as_ns().into();
            header
        };
        cameras.iter().enumerate().map(header).collect()
    }

    /// Returns the rendered images, for the log.
    pub(super) fn given<'a>(
        &'a self,
        cameras: &'a [CameraInfo],
        headers: &'a [ImageHeader],
    ) -> Vec<GivenImage<'a>> {
        let pose = HostTime::from_ns(self.pose.as_ns());
        let given = |((camera, header), picture): ((&'a CameraInfo, _), &'a Option<Picture>)| {
            let Picture { rgb, depth_mm, .. } = picture.as_ref()?;
            Some(GivenImage { header, name: camera.name.as_str(), pose, rgb, depth_mm })
        };
        cameras.iter().zip(headers).zip(&self.rendered).filter_map(given).collect()
    }
}
