//! The ROS 2 messages that are sent and received, field by field as in their `.msg` files, which are the same from
//! Humble to Rolling. Strings and sequences borrow where possible; fields that are always zero here are omitted.

use std::borrow::Cow;

use vizflyt_sdk::glam::{DQuat, DVec3};

use crate::cdr::{CdrError, Reader, Writer};

/// A message that can be sent.
pub trait Message {
    /// ROS name of the type, for example `sensor_msgs/msg/Image`.
    const TYPE: &'static str;

    fn write(&self, writer: &mut Writer);

    /// Returns the approximate size, to avoid reallocation. [bytes]
    fn size_hint(&self) -> usize {
        512
    }

    /// Returns the message as bytes, without the encapsulation header.
    fn encode(&self) -> Vec<u8> {
        let mut writer = Writer::with_capacity(self.size_hint());
        self.write(&mut writer);
        writer.into_bytes()
    }
}

impl<M: Message> Message for &M {
    const TYPE: &'static str = M::TYPE;

    fn write(&self, writer: &mut Writer) {
        (*self).write(writer);
    }

    fn size_hint(&self) -> usize {
        (*self).size_hint()
    }
}

/// A message that can be received.
pub trait Received: Message + Sized {
    /// Reads a message.
    ///
    /// # Errors
    /// [`CdrError`] if the bytes do not decode.
    fn read(reader: &mut Reader<'_>) -> Result<Self, CdrError>;
}

/// builtin_interfaces/Time: time since 1970.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Time {
    /// [s]
    pub sec: i32,
    /// [ns]
    pub nanosec: u32,
}

impl Time {
    /// Returns the time this many nanoseconds after 1970.
    pub fn from_ns(ns: i64) -> Self {
        let (sec, nanosec) = (ns.div_euclid(1_000_000_000), ns.rem_euclid(1_000_000_000));
        Self { sec: sec.clamp(i32::MIN.into(), i32::MAX.into()) as i32, nanosec: nanosec as u32 }
    }
}

/// std_msgs/Header.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Header {
    /// Time of the content.
    pub stamp: Time,
    /// Frame of the content.
    pub frame_id: String,
}

impl Header {
    fn write(&self, writer: &mut Writer) {
        writer.i32(self.stamp.sec);
        writer.u32(self.stamp.nanosec);
        writer.text(&self.frame_id);
    }

    fn read(reader: &mut Reader<'_>) -> Result<Self, CdrError> {
        let stamp = Time { sec: reader.i32()?, nanosec: reader.u32()? };
        Ok(Self { stamp, frame_id: reader.text()?.to_owned() })
    }
}

fn write_vector(writer: &mut Writer, vector: DVec3) {
    writer.f64s(&vector.to_array());
}

fn write_quaternion(writer: &mut Writer, rotation: DQuat) {
    writer.f64s(&rotation.to_array());
}

fn read_vector(reader: &mut Reader<'_>) -> Result<DVec3, CdrError> {
    reader.f64s().map(DVec3::from_array)
}

/// sensor_msgs/Image, little-endian.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image<'a> {
    /// Instant that the image shows, and the optical frame.
    pub header: Header,
    /// Rows.
    pub height: u32,
    /// Columns.
    pub width: u32,
    /// `rgb8`, `32FC1`, `16UC1`.
    pub encoding: &'static str,
    /// Bytes per row.
    pub step: u32,
    /// Rows, the top one first.
    pub data: Cow<'a, [u8]>,
}

impl Message for Image<'_> {
    const TYPE: &'static str = "sensor_msgs/msg/Image";

    fn write(&self, writer: &mut Writer) {
        self.header.write(writer);
        writer.u32(self.height);
        writer.u32(self.width);
        writer.text(self.encoding);
        writer.u8(0);
        writer.u32(self.step);
        writer.blob(&self.data);
    }

    fn size_hint(&self) -> usize {
        self.data.len() + 256
    }
}

/// sensor_msgs/CompressedImage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CompressedImage {
    /// The same as the image's.
    pub header: Header,
    /// `jpeg`.
    pub format: &'static str,
    /// The JPEG file.
    pub data: Vec<u8>,
}

impl Message for CompressedImage {
    const TYPE: &'static str = "sensor_msgs/msg/CompressedImage";

    fn write(&self, writer: &mut Writer) {
        self.header.write(writer);
        writer.text(self.format);
        writer.blob(&self.data);
    }

    fn size_hint(&self) -> usize {
        self.data.len() + 256
    }
}

/// sensor_msgs/CameraInfo, without binning and region of interest.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// The same as the image's.
    pub header: Header,
    /// Rows.
    pub height: u32,
    /// Columns.
    pub width: u32,
    /// `plumb_bob` or `equidistant`.
    pub distortion_model: &'static str,
    /// Distortion coefficients.
    pub d: Vec<f64>,
    /// Intrinsics, 3 x 3, row by row; pixel centres are whole numbers, as in OpenCV.
    pub k: [f64; 9],
    /// Projection, 3 x 4, row by row.
    pub p: [f64; 12],
}

impl Message for CameraInfo {
    const TYPE: &'static str = "sensor_msgs/msg/CameraInfo";

    fn write(&self, writer: &mut Writer) {
        self.header.write(writer);
        writer.u32(self.height);
        writer.u32(self.width);
        writer.text(self.distortion_model);
        writer.u32(self.d.len() as u32);
        writer.f64s(&self.d);
        writer.f64s(&self.k);
        writer.f64s(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
        writer.f64s(&self.p);
        // No binning, and no region of interest.
        (0..6).for_each(|_| writer.u32(0));
        writer.u8(0);
    }
}

/// geometry_msgs/PoseStamped.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseStamped {
    /// Instant and parent frame.
    pub header: Header,
    /// [m]
    pub position: DVec3,
    /// Unit, xyzw.
    pub orientation: DQuat,
}

impl Message for PoseStamped {
    const TYPE: &'static str = "geometry_msgs/msg/PoseStamped";

    fn write(&self, writer: &mut Writer) {
        self.header.write(writer);
        write_vector(writer, self.position);
        write_quaternion(writer, self.orientation);
    }
}

impl Received for PoseStamped {
    fn read(reader: &mut Reader<'_>) -> Result<Self, CdrError> {
        let header = Header::read(reader)?;
        let (position, [x, y, z, w]) = (read_vector(reader)?, reader.f64s()?);
        Ok(Self { header, position, orientation: DQuat::from_xyzw(x, y, z, w) })
    }
}

/// nav_msgs/Odometry. Its covariances are zero, which means unknown.
#[derive(Clone, Debug, PartialEq)]
pub struct Odometry {
    /// Instant and frame of the pose.
    pub header: Header,
    /// Frame of the twist.
    pub child_frame_id: String,
    /// [m]
    pub position: DVec3,
    /// Unit, xyzw.
    pub orientation: DQuat,
    /// [m/s, child frame]
    pub linear: DVec3,
    /// [rad/s, child frame]
    pub angular: DVec3,
}

impl Message for Odometry {
    const TYPE: &'static str = "nav_msgs/msg/Odometry";

    fn write(&self, writer: &mut Writer) {
        self.header.write(writer);
        writer.text(&self.child_frame_id);
        write_vector(writer, self.position);
        write_quaternion(writer, self.orientation);
        writer.f64s(&[0.0; 36]);
        write_vector(writer, self.linear);
        write_vector(writer, self.angular);
        writer.f64s(&[0.0; 36]);
    }

    fn size_hint(&self) -> usize {
        1024
    }
}

/// geometry_msgs/TransformStamped.
#[derive(Clone, Debug, PartialEq)]
pub struct TransformStamped {
    /// Instant and parent frame.
    pub header: Header,
    /// Frame that this transform places in the parent frame.
    pub child_frame_id: String,
    /// [m, parent]
    pub translation: DVec3,
    /// Unit, xyzw.
    pub rotation: DQuat,
}

/// tf2_msgs/TFMessage.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TfMessage {
    pub transforms: Vec<TransformStamped>,
}

impl Message for TfMessage {
    const TYPE: &'static str = "tf2_msgs/msg/TFMessage";

    fn write(&self, writer: &mut Writer) {
        writer.u32(self.transforms.len() as u32);
        for transform in &self.transforms {
            transform.header.write(writer);
            writer.text(&transform.child_frame_id);
            write_vector(writer, transform.translation);
            write_quaternion(writer, transform.rotation);
        }
    }
}

/// sensor_msgs/Imu without an orientation, which a first covariance of -1 marks.
#[derive(Clone, Debug, PartialEq)]
pub struct Imu {
    /// Instant and frame of both vectors.
    pub header: Header,
    /// [rad/s]
    pub angular_velocity: DVec3,
    /// Specific force: +9.8 along z at rest. [m/s^2]
    pub linear_acceleration: DVec3,
}

impl Message for Imu {
    const TYPE: &'static str = "sensor_msgs/msg/Imu";

    fn write(&self, writer: &mut Writer) {
        self.header.write(writer);
        write_quaternion(writer, DQuat::IDENTITY);
        writer.f64(-1.0);
        writer.f64s(&[0.0; 8]);
        write_vector(writer, self.angular_velocity);
        writer.f64s(&[0.0; 9]);
        write_vector(writer, self.linear_acceleration);
        writer.f64s(&[0.0; 9]);
    }
}

/// sensor_msgs/PointField: name, offset in a point [bytes], and datatype constant.
pub type PointField = (&'static str, u32, u8);
/// PointField.UINT16.
pub const UINT16: u8 = 4;
/// PointField.UINT32.
pub const UINT32: u8 = 6;
/// PointField.FLOAT32.
pub const FLOAT32: u8 = 7;

/// sensor_msgs/PointCloud2, little-endian.
#[derive(Clone, Debug, PartialEq)]
pub struct PointCloud2<'a> {
    /// Instant and frame of the points.
    pub header: Header,
    /// Rows; 1 if the points have no order.
    pub height: u32,
    /// Points per row.
    pub width: u32,
    /// Fields of a point.
    pub fields: &'static [PointField],
    /// Bytes per point.
    pub point_step: u32,
    pub data: Cow<'a, [u8]>,
    /// Whether no point is NaN.
    pub is_dense: bool,
}

impl Message for PointCloud2<'_> {
    const TYPE: &'static str = "sensor_msgs/msg/PointCloud2";

    fn write(&self, writer: &mut Writer) {
        self.header.write(writer);
        writer.u32(self.height);
        writer.u32(self.width);
        writer.u32(self.fields.len() as u32);
        for &(name, offset, datatype) in self.fields {
            writer.text(name);
            writer.u32(offset);
            writer.u8(datatype);
            writer.u32(1);
        }
        writer.u8(0);
        writer.u32(self.point_step);
        writer.u32(self.point_step * self.width);
        writer.blob(&self.data);
        writer.u8(self.is_dense.into());
    }

    fn size_hint(&self) -> usize {
        self.data.len() + 512
    }
}

/// geometry_msgs/TwistStamped.
#[derive(Clone, Debug, PartialEq)]
pub struct TwistStamped {
    /// Frame of the vectors.
    pub header: Header,
    /// [m/s]
    pub linear: DVec3,
    /// [rad/s]
    pub angular: DVec3,
}

impl Message for TwistStamped {
    const TYPE: &'static str = "geometry_msgs/msg/TwistStamped";

    fn write(&self, writer: &mut Writer) {
        self.header.write(writer);
        write_vector(writer, self.linear);
        write_vector(writer, self.angular);
    }
}

impl Received for TwistStamped {
    fn read(reader: &mut Reader<'_>) -> Result<Self, CdrError> {
        let header = Header::read(reader)?;
        Ok(Self { header, linear: read_vector(reader)?, angular: read_vector(reader)? })
    }
}

/// nav_msgs/Path.
#[derive(Clone, Debug, PartialEq)]
pub struct Path {
    /// Frame of the points.
    pub header: Header,
    /// Points of the path. Each frame must be empty or equal to the path's frame.
    pub poses: Vec<PoseStamped>,
}

impl Path {
    /// Maximum number of poses that are read, because more cannot be flown; limits allocation.
    pub const MOST_POSES: u32 = 1024;
}

impl Message for Path {
    const TYPE: &'static str = "nav_msgs/msg/Path";

    fn write(&self, writer: &mut Writer) {
        self.header.write(writer);
        writer.u32(self.poses.len() as u32);
        self.poses.iter().for_each(|pose| pose.write(writer));
    }
}

impl Received for Path {
    fn read(reader: &mut Reader<'_>) -> Result<Self, CdrError> {
        let header = Header::read(reader)?;
        let count = reader.count(Self::MOST_POSES)?;
        let poses = (0..count).map(|_| PoseStamped::read(reader)).collect::<Result<_, _>>()?;
        Ok(Self { header, poses })
    }
}

/// std_msgs/Empty, which is one byte on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Empty;

impl Message for Empty {
    const TYPE: &'static str = "std_msgs/msg/Empty";

    fn write(&self, writer: &mut Writer) {
        writer.u8(0);
    }
}

impl Received for Empty {
    fn read(reader: &mut Reader<'_>) -> Result<Self, CdrError> {
        reader.u8().map(|_| Self)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn header() -> impl Strategy<Value = Header> {
        (any::<i32>(), any::<u32>(), "[a-z_/]{0,40}")
            .prop_map(|(sec, nanosec, frame_id)| Header { stamp: Time { sec, nanosec }, frame_id })
    }

    fn vector() -> impl Strategy<Value = DVec3> {
        any::<[f64; 3]>().prop_map(DVec3::from_array)
    }

    fn pose() -> impl Strategy<Value = PoseStamped> {
        (header(), vector(), any::<[f64; 4]>()).prop_map(|(header, position, q)| PoseStamped {
            header,
            position,
            orientation: DQuat::from_array(q),
        })
    }

    fn check<M: Received + PartialEq + std::fmt::Debug>(message: &M) {
        let bytes = message.encode();
        assert_eq!(&M::read(&mut Reader::new(&bytes, true)).unwrap(), message);
        // No prefix is a complete message.
        for end in 0..bytes.len() {
            assert!(M::read(&mut Reader::new(&bytes[..end], true)).is_err());
        }
    }

    proptest! {
        #[test]
        fn messages_round_trip(
            header in header(),
            linear in vector(),
            angular in vector(),
            poses in proptest::collection::vec(pose(), 0..4),
        ) {
            check(&TwistStamped { header: header.clone(), linear, angular });
            check(&Path { header, poses });
        }

        #[test]
        fn arbitrary_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400), little: bool) {
            let _ = TwistStamped::read(&mut Reader::new(&bytes, little));
            let _ = PoseStamped::read(&mut Reader::new(&bytes, little));
            if let Ok(path) = Path::read(&mut Reader::new(&bytes, little)) {
                prop_assert!(path.poses.len() * 8 <= bytes.len());
            }
        }
    }

    #[test]
    fn converts_times_before_and_after_1970() {
        assert_eq!(Time::from_ns(-1), Time { sec: -1, nanosec: 999_999_999 });
        assert_eq!(Time::from_ns(1_500_000_000), Time { sec: 1, nanosec: 500_000_000 });
    }
}
