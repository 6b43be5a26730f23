//! Header and trailer of an image on a separate unidirectional QUIC stream. The header contains everything known at the
//! end of rendering. The bitstream follows slice by slice as it is encoded, then the trailer.

use glam::{DQuat, DVec3};
use zerocopy::byteorder::little_endian::{F64, U16, U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::PROTOCOL_VERSION;
use crate::geometry::{Body, Cam, Distortion, Intrinsics, InvalidIntrinsics, Pose, World};
use crate::time::ServerTime;

/// Header of an image: camera, time stamps and pose. The RGB-D bitstream (`vizflyt-rgbd`) follows while it is encoded,
/// then an [`ImageTrailer`], then the stream ends.
///
/// Stamps use the server's clock. Depth in the payload is camera z in units of `depth_unit_m`, and 0 without a return
/// (REP 118).
#[derive(
    Clone, Copy, Debug, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned,
)]
#[repr(C)]
pub struct ImageHeader {
    magic: [u8; 4],
    version: U16,
    /// Index into [`crate::messages::ArenaInfo::cameras`].
    pub camera: u8,
    /// Lens model: 0 none, 1 Brown-Conrady, 2 Kannala-Brandt.
    pub distortion_model: u8,
    /// Number of the server's tick; equal for all cameras of a tick.
    pub seq: U64,
    /// Time at which the newest pose used for the image was measured. The age of the image counts from here. [ns,
    /// server]
    pub pose_ns: U64,
    /// Time that the image shows. The pose is predicted to it, so it may be later than all other stamps. [ns, server]
    pub exposure_ns: U64,
    /// Start of rendering. [ns, server]
    pub render_start_ns: U64,
    /// End of rendering. [ns, server]
    pub render_end_ns: U64,
    /// Camera position. [m, world]
    pub translation_m: [F64; 3],
    /// Camera-to-world rotation, xyzw.
    pub rotation_xyzw: [F64; 4],
    /// Camera position on the body. Cameras may be moved in flight. [m, body]
    pub mount_m: [F64; 3],
    /// Camera-to-body rotation, xyzw.
    pub mount_xyzw: [F64; 4],
    /// fx, fy, cx, cy. [px]
    pub intrinsics_px: [F64; 4],
    /// Distortion coefficients in the order of OpenCV, padded with zeros.
    pub distortion: [F64; 5],
    /// Image width. [px]
    pub width_px: U32,
    /// Image height. [px]
    pub height_px: U32,
    /// Metres per unit of depth; 0.001.
    pub depth_unit_m: F64,
    /// Bit mask of the cameras whose images are sent together with this one. A receiver that has all of them need not
    /// wait for cameras of another rate. 0 if unknown.
    pub together: U32,
}

/// Reason why bytes are not a valid image header.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum InvalidImageHeader {
    /// Fewer bytes than a header.
    #[error("image header is cut short at {0} of {size} bytes", size = ImageHeader::SIZE)]
    Short(usize),
    /// Wrong magic or version.
    #[error("these bytes are not an image header of protocol {PROTOCOL_VERSION}")]
    Foreign,
    /// Invalid intrinsics of the camera.
    #[error("image header: {0}")]
    Intrinsics(InvalidIntrinsics),
    /// Lens model that this version does not support.
    #[error("image header: lens model {0} is unknown")]
    Lens(u8),
    /// Pose or depth unit out of range, or quaternion without unit length.
    #[error("image header: camera pose or depth unit is out of range")]
    Pose,
}

impl ImageHeader {
    /// Size on the wire. [bytes]
    pub const SIZE: usize = size_of::<Self>();
    const MAGIC: [u8; 4] = *b"VZIM";
    /// First protocol version with this layout.
    const SINCE: u16 = 13;

    /// Returns the header of an image that shows the time of its pose, with all other stamps zero.
    pub fn new(
        seq: u64,
        camera: u8,
        pose: ServerTime,
        k: &Intrinsics,
        body_from_cam: &Pose<Body, Cam>,
        world_from_body: &Pose<World, Body>,
    ) -> Self {
        let (distortion_model, distortion) = k.distortion.to_wire();
        let world_from_cam = *world_from_body * *body_from_cam;
        Self {
            magic: Self::MAGIC,
            version: PROTOCOL_VERSION.into(),
            camera,
            distortion_model,
            seq: seq.into(),
            pose_ns: pose.as_ns().into(),
            exposure_ns: pose.as_ns().into(),
            render_start_ns: 0.into(),
            render_end_ns: 0.into(),
            translation_m: world_from_cam.translation_m.to_array().map(F64::new),
            rotation_xyzw: world_from_cam.rotation.to_array().map(F64::new),
            mount_m: body_from_cam.translation_m.to_array().map(F64::new),
            mount_xyzw: body_from_cam.rotation.to_array().map(F64::new),
            intrinsics_px: [k.fx_px, k.fy_px, k.cx_px, k.cy_px].map(F64::new),
            distortion: distortion.map(F64::new),
            width_px: k.width_px.into(),
            height_px: k.height_px.into(),
            depth_unit_m: F64::new(0.001),
            together: 0.into(),
        }
    }

    /// Reads and validates a header at the start of `bytes`. Returns it and the remaining bytes.
    pub fn parse(bytes: &[u8]) -> Result<(Self, &[u8]), InvalidImageHeader> {
        Self::parse_logged(bytes, PROTOCOL_VERSION.into())
    }

    /// Like [`Self::parse`], for a header in a log of another protocol version. The layout has not changed since
    /// version 13.
    pub fn parse_logged(bytes: &[u8], protocol: u32) -> Result<(Self, &[u8]), InvalidImageHeader> {
        let (header, rest) =
            Self::read_from_prefix(bytes).map_err(|_| InvalidImageHeader::Short(bytes.len()))?;
        let is_known = (Self::SINCE.into()..=PROTOCOL_VERSION.into()).contains(&protocol);
        if header.magic != Self::MAGIC || !is_known || u32::from(header.version.get()) != protocol {
            return Err(InvalidImageHeader::Foreign);
        }
        if Distortion::from_wire(header.distortion_model, [0.0; 5]).is_none() {
            return Err(InvalidImageHeader::Lens(header.distortion_model));
        }
        header.intrinsics().validate().map_err(InvalidImageHeader::Intrinsics)?;
        let unit_m = header.depth_unit_m.get();
        let posed = header.world_from_cam().is_valid() && header.body_from_cam().is_valid();
        if !(posed && (1e-6..=1.0).contains(&unit_m)) {
            return Err(InvalidImageHeader::Pose);
        }
        Ok((header, rest))
    }

    /// Returns the maximum number of bitstream bytes for an image of this size. A receiver aborts if it gets more.
    pub fn most_payload(&self) -> u64 {
        // Eight bytes per pixel plus overhead exceed every mode of the bitstream.
        8 * u64::from(self.width_px.get()) * u64::from(self.height_px.get()) + 65536
    }

    /// Returns the camera's intrinsics.
    pub fn intrinsics(&self) -> Intrinsics {
        let [fx_px, fy_px, cx_px, cy_px] = self.intrinsics_px.map(F64::get);
        Intrinsics {
            width_px: self.width_px.get(),
            height_px: self.height_px.get(),
            fx_px,
            fy_px,
            cx_px,
            cy_px,
            distortion: Distortion::from_wire(self.distortion_model, self.distortion.map(F64::get))
                .unwrap_or_default(),
        }
    }

    /// Returns the pose of the camera in the world.
    pub fn world_from_cam(&self) -> Pose<World, Cam> {
        Pose::new(
            DVec3::from_array(self.translation_m.map(F64::get)),
            DQuat::from_array(self.rotation_xyzw.map(F64::get)),
        )
    }

    /// Returns the pose of the camera on the body.
    pub fn body_from_cam(&self) -> Pose<Body, Cam> {
        Pose::new(
            DVec3::from_array(self.mount_m.map(F64::get)),
            DQuat::from_array(self.mount_xyzw.map(F64::get)),
        )
    }

    /// Returns the pose of the body at the time that the image shows.
    pub fn world_from_body(&self) -> Pose<World, Body> {
        self.world_from_cam() * self.body_from_cam().inverse()
    }

    /// Returns the time that the image shows.
    pub fn exposure_stamp(&self) -> ServerTime {
        ServerTime::from_ns(self.exposure_ns.get())
    }

    /// Returns the stamp of the pose.
    pub fn pose_stamp(&self) -> ServerTime {
        ServerTime::from_ns(self.pose_ns.get())
    }
}

/// Trailer at the end of the stream: values that are known only after the last byte of the bitstream.
///
/// No checksum: QUIC authenticates every packet.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned,
)]
#[repr(C)]
pub struct ImageTrailer {
    magic: [u8; 4],
    /// Number of bitstream bytes between header and trailer.
    pub payload_len: U32,
    /// End of encoding. [ns, server]
    pub encode_end_ns: U64,
    /// Time at which the first byte was passed to the transport, during encoding. [ns, server]
    pub send_ns: U64,
}

/// Reason why bytes are not a valid image trailer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidImageTrailer {
    /// Wrong magic: the image is incomplete or longer than announced.
    #[error("the image does not end with a trailer")]
    Foreign,
    /// The number of received bytes differs from the number sent.
    #[error("image trailer: {announced} bytes were announced, {came} arrived")]
    Length {
        /// Number of bitstream bytes according to the trailer.
        announced: u32,
        /// Number of bitstream bytes received.
        came: u64,
    },
}

impl ImageTrailer {
    /// Size on the wire. [bytes]
    pub const SIZE: usize = size_of::<Self>();
    const MAGIC: [u8; 4] = *b"VZIE";

    /// Returns the trailer of a bitstream of `payload_len` bytes.
    pub fn new(payload_len: u32, encode_end: ServerTime, send: ServerTime) -> Self {
        Self {
            magic: Self::MAGIC,
            payload_len: payload_len.into(),
            encode_end_ns: encode_end.as_ns().into(),
            send_ns: send.as_ns().into(),
        }
    }

    /// Reads the trailer of an image with `came` received bytes of bitstream.
    pub fn parse(bytes: &[u8; Self::SIZE], came: u64) -> Result<Self, InvalidImageTrailer> {
        let Ok(trailer) = Self::read_from_bytes(bytes) else {
            return Err(InvalidImageTrailer::Foreign);
        };
        if trailer.magic != Self::MAGIC {
            return Err(InvalidImageTrailer::Foreign);
        }
        let announced = trailer.payload_len.get();
        if u64::from(announced) != came {
            return Err(InvalidImageTrailer::Length { announced, came });
        }
        Ok(trailer)
    }
}

// The layout is an interface between both ends.
const _: () = assert!(ImageHeader::SIZE == 252 && ImageTrailer::SIZE == 24);

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn header() -> ImageHeader {
        let k = Intrinsics::from_horizontal_fov(320, 240, 1.3);
        let body_from_cam = crate::geometry::body_from_forward_cam(DVec3::X, 0.2);
        let world_from_body = Pose::new(DVec3::Z, DQuat::from_rotation_z(0.5));
        ImageHeader::new(9, 1, ServerTime::from_ns(77), &k, &body_from_cam, &world_from_body)
    }

    #[test]
    fn a_header_survives_the_wire() {
        let sent = header();
        let (found, rest) = ImageHeader::parse(sent.as_bytes()).unwrap();
        assert_eq!(found, sent);
        assert!(rest.is_empty());
        assert_eq!(found.pose_stamp(), ServerTime::from_ns(77));
        // 1 m ahead of a body that is rotated by 0.5 rad, 1 m up.
        let p = found.world_from_cam().translation_m;
        assert!((p - DVec3::new(0.87758, 0.47943, 1.0)).length() < 1e-5, "{p}");
        assert_eq!(found.body_from_cam().translation_m, DVec3::X);
    }

    #[test]
    fn rejects_invalid_headers() {
        let mut h = header();
        h.rotation_xyzw = [0.0; 4].map(F64::new);
        assert_eq!(ImageHeader::parse(h.as_bytes()), Err(InvalidImageHeader::Pose));
        let mut h = header();
        h.mount_m[1] = F64::new(f64::NAN);
        assert_eq!(ImageHeader::parse(h.as_bytes()), Err(InvalidImageHeader::Pose));
        let mut h = header();
        h.width_px = 0.into();
        assert!(matches!(ImageHeader::parse(h.as_bytes()), Err(InvalidImageHeader::Intrinsics(_))));
        assert_eq!(ImageHeader::parse(&[0; 20]), Err(InvalidImageHeader::Short(20)));
    }

    #[test]
    fn rejects_a_trailer_that_does_not_match() {
        let trailer = ImageTrailer::new(7, ServerTime::from_ns(3), ServerTime::from_ns(2));
        let mut bytes = [0; ImageTrailer::SIZE];
        bytes.copy_from_slice(trailer.as_bytes());
        let short = InvalidImageTrailer::Length { announced: 7, came: 6 };
        assert_eq!(ImageTrailer::parse(&bytes, 6), Err(short));
        bytes[3] = b'M';
        assert_eq!(ImageTrailer::parse(&bytes, 7), Err(InvalidImageTrailer::Foreign));
    }

    proptest! {
        #[test]
        fn headers_survive_the_wire(
            seq: u64, camera: u8, pose: u64, exposure: u64, start: u64, end: u64, together: u32,
            width in 1u32..9000, height in 1u32..9000, fov in 0.2f64..2.5,
        ) {
            let k = Intrinsics::from_horizontal_fov(width, height, fov);
            let mount = crate::geometry::body_from_forward_cam(DVec3::Y, 0.1);
            let pose = ServerTime::from_ns(pose);
            let mut sent = ImageHeader::new(seq, camera, pose, &k, &mount, &Pose::IDENTITY);
            (sent.exposure_ns, sent.together) = (exposure.into(), together.into());
            (sent.render_start_ns, sent.render_end_ns) = (start.into(), end.into());
            match ImageHeader::parse(sent.as_bytes()) {
                Ok((found, rest)) => prop_assert!(found == sent && rest.is_empty()),
                Err(_) => prop_assert!(width.max(height) > Intrinsics::MAX_SIDE_PX),
            }
            let pixels = u64::from(width) * u64::from(height);
            prop_assert!(sent.most_payload() > 8 * pixels);
        }

        #[test]
        fn trailers_survive_the_wire(len: u32, end: u64, send: u64) {
            let sent = ImageTrailer::new(len, ServerTime::from_ns(end), ServerTime::from_ns(send));
            let bytes = sent.as_bytes().first_chunk().unwrap();
            prop_assert_eq!(ImageTrailer::parse(bytes, len.into()), Ok(sent));
        }

        #[test]
        fn any_trailer_parses_or_fails_cleanly(bytes: [u8; ImageTrailer::SIZE], came: u64) {
            if let Ok(trailer) = ImageTrailer::parse(&bytes, came) {
                prop_assert_eq!(trailer.as_bytes(), &bytes);
            }
        }

        #[test]
        fn any_bytes_parse_or_fail_cleanly(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            let _ = ImageHeader::parse(&bytes);
        }
    }
}
