//! `[[localization]]`: where poses come from, and how the stream's numbers become poses of the
//! vehicle in the `world` frame.
//!
//! ```text
//! stream's position * units -> axes -> offset ----------------> position  [m, world]
//! stream's rotation (euler, quaternion) -> axes, body -> nose --> attitude  (body to world)
//! ```
//! Each setting is something a person can see in the room, so that `vizflyt doctor localization`
//! can name the one to change.

mod driver;

use std::collections::BTreeMap;
use std::fmt;
use std::net::Ipv4Addr;
use std::path::Path;
use std::str::FromStr;

use anyhow::{Context, Result};
use glam::{DMat3, DQuat, DVec3, EulerRot};
use serde::{Deserialize, Serialize};
use vizflyt_arena::config::{ConfigError, check_number, check_position, invalid};
use vizflyt_protocol::geometry::{Body, Pose, World};

pub use self::driver::Driver;
use crate::scene;

/// `[[localization]]`: one source of poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalizationConfig {
    /// What sends them.
    pub driver: Driver,
    /// Where they come from or arrive, as the driver reads it; its usual address by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
    /// Length unit of the stream; the driver's own by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub units: Option<Units>,
    /// The stream's axis that points up; a short form of `axes`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub up: Option<UpAxis>,
    /// Which of the stream's axes the world's x, y and z are: `xyz` by default, `x-zy` for y up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub axes: Option<Axes>,
    /// Vicon: the order in which its three angles turn about the fixed axes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub euler: Option<Euler>,
    /// NatNet, JSON: how the four numbers of a quaternion are meant.
    #[serde(default, skip_serializing_if = "is_default")]
    pub quaternion: Quaternion,
    /// How the object's own axes are laid; as the stream's by default.
    #[serde(default, skip_serializing_if = "is_default")]
    pub body: BodyAxes,
    /// Where the vehicle's nose points in the object's level axes; along x by default.
    #[serde(default, skip_serializing_if = "is_default")]
    pub nose: Nose,
    /// Where the stream's origin is in the world, and how it is turned there.
    #[serde(default, skip_serializing_if = "is_default")]
    pub offset: Offset,
    /// Where the tracked point is on the vehicle. [m, body]
    #[serde(default, skip_serializing_if = "is_default")]
    pub pivot_m: DVec3,
    /// How much earlier than stamped, or than its arrival where it has no stamp, a pose was true: the source's own
    /// constant delay, 0 to 500. [ms]
    #[serde(default, skip_serializing_if = "is_default")]
    pub latency_ms: f64,
    /// Names of the vehicles' objects in the stream, where they differ from the vehicles' names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub objects: BTreeMap<String, String>,
    /// NatNet by multicast: our address in the network that it comes from, where there are several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interface: Option<Ipv4Addr>,
    /// VRPN: which sensor of a tracker the vehicle is; 0 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<u16>,
}

/// A length unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Units {
    /// Metres.
    #[serde(rename = "m")]
    Metres,
    /// Centimetres.
    #[serde(rename = "cm")]
    Centimetres,
    /// Millimetres.
    #[serde(rename = "mm")]
    Millimetres,
}

impl Units {
    /// Every unit.
    pub const ALL: [Self; 3] = [Self::Metres, Self::Centimetres, Self::Millimetres];

    /// Returns how many metres one is. [m]
    pub fn metres(self) -> f64 {
        match self {
            Self::Metres => 1.0,
            Self::Centimetres => 1e-2,
            Self::Millimetres => 1e-3,
        }
    }
}

impl fmt::Display for Units {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Metres => "m",
            Self::Centimetres => "cm",
            Self::Millimetres => "mm",
        })
    }
}

/// Which axis of a stream points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpAxis {
    /// As in the world.
    Z,
    /// As Motive does by default: x right, y up, z towards the viewer.
    Y,
}

impl UpAxis {
    /// Returns the same as axes.
    pub fn axes(self) -> Axes {
        match self {
            Self::Z => Axes::IDENTITY,
            Self::Y => Axes([(0, false), (2, true), (1, false)]),
        }
    }
}

/// Which of the stream's axes the world's x, y and z are, each possibly reversed: `x-zy` means
/// that the world's y is the stream's -z, and its z the stream's y.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Axes([(usize, bool); 3]);

impl Axes {
    /// `xyz`: the stream's axes are the world's.
    pub const IDENTITY: Self = Self([(0, false), (1, false), (2, false)]);

    /// Returns all 48, half of them mirrors.
    pub fn all() -> impl Iterator<Item = Self> {
        let orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
        orders.into_iter().flat_map(|order| {
            (0..8).map(move |signs| {
                Self(std::array::from_fn(|row| (order[row], signs >> row & 1 == 1)))
            })
        })
    }

    /// Returns the matrix that takes the stream's coordinates to the world's.
    pub fn matrix(self) -> DMat3 {
        let mut rows = [DVec3::ZERO; 3];
        for (row, (axis, turned)) in rows.iter_mut().zip(self.0) {
            row[axis] = if turned { -1.0 } else { 1.0 };
        }
        DMat3::from_cols(rows[0], rows[1], rows[2]).transpose()
    }

    /// Whether left and right are exchanged.
    pub fn is_mirror(self) -> bool {
        self.matrix().determinant() < 0.0
    }
}

impl FromStr for Axes {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || {
            format!("'{text}': name each of x, y and z once, with a minus where it is turned: x-zy")
        };
        let mut found = Vec::with_capacity(3);
        let mut turned = false;
        for letter in text.chars() {
            match letter {
                '-' if !turned => turned = true,
                'x' | 'y' | 'z' => {
                    found.push((letter as usize - 'x' as usize, std::mem::take(&mut turned)));
                }
                _ => return Err(wrong()),
            }
        }
        let axes: [(usize, bool); 3] = found.try_into().map_err(|_| wrong())?;
        let mut seen = axes.map(|(axis, _)| axis);
        seen.sort_unstable();
        if turned || seen != [0, 1, 2] { Err(wrong()) } else { Ok(Self(axes)) }
    }
}

impl fmt::Display for Axes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|&(axis, turned)| {
            write!(f, "{}{}", if turned { "-" } else { "" }, ["x", "y", "z"][axis])
        })
    }
}

/// Text form through `Display` and `FromStr`.
macro_rules! as_text {
    ($($type:ty),*) => {$(
        impl Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.collect_str(self)
            }
        }
        impl<'de> Deserialize<'de> for $type {
            fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
            }
        }
    )*};
}
as_text!(Axes, Euler, Quaternion);

/// How three angles about x, y and z make a rotation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Euler {
    /// `xyz`: about the fixed x first, then the fixed y, then the fixed z: `Rz Ry Rx`.
    #[default]
    Xyz,
    /// `xzy`: `Ry Rz Rx`.
    Xzy,
    /// `yxz`: `Rz Rx Ry`.
    Yxz,
    /// `yzx`: `Rx Rz Ry`.
    Yzx,
    /// `zxy`: `Ry Rx Rz`.
    Zxy,
    /// `zyx`: `Rx Ry Rz`, the same as turns about the object's own x, then y, then z.
    Zyx,
    /// `vector`: the three are an axis, its length the angle.
    Vector,
}

impl Euler {
    /// Every way.
    pub const ALL: [Self; 7] =
        [Self::Xyz, Self::Xzy, Self::Yxz, Self::Yzx, Self::Zxy, Self::Zyx, Self::Vector];

    /// Returns the name by which it is chosen.
    pub fn name(self) -> &'static str {
        ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "vector"][self as usize]
    }

    /// The same order as glam has it: about moving axes, so read backwards.
    fn moving(self) -> Option<EulerRot> {
        Some(match self {
            Self::Xyz => EulerRot::ZYX,
            Self::Xzy => EulerRot::YZX,
            Self::Yxz => EulerRot::ZXY,
            Self::Yzx => EulerRot::XZY,
            Self::Zxy => EulerRot::YXZ,
            Self::Zyx => EulerRot::XYZ,
            Self::Vector => return None,
        })
    }

    /// Returns where about x, y and z the order's first, second and third turn are, as glam has it.
    fn places(self) -> [usize; 3] {
        match self {
            Self::Xyz | Self::Vector => [2, 1, 0],
            Self::Xzy => [1, 2, 0],
            Self::Yxz => [2, 0, 1],
            Self::Yzx => [0, 2, 1],
            Self::Zxy => [1, 0, 2],
            Self::Zyx => [0, 1, 2],
        }
    }

    /// Returns the rotation of angles about x, y and z. [rad]
    pub fn rotation(self, angles_rad: DVec3) -> DQuat {
        let Some(order) = self.moving() else { return DQuat::from_scaled_axis(angles_rad) };
        let [a, b, c] = self.places().map(|axis| angles_rad[axis]);
        DQuat::from_euler(order, a, b, c)
    }

    /// Returns the angles about x, y and z of a rotation. [rad]
    pub fn angles(self, rotation: DQuat) -> DVec3 {
        let Some(order) = self.moving() else { return rotation.to_scaled_axis() };
        let (a, b, c) = rotation.to_euler(order);
        let mut angles_rad = DVec3::ZERO;
        for (axis, value) in self.places().into_iter().zip([a, b, c]) {
            angles_rad[axis] = value;
        }
        angles_rad
    }
}

impl fmt::Display for Euler {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Euler {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|euler| euler.name() == text);
        found.ok_or_else(|| format!("'{text}': write {}", Self::ALL.map(Self::name).join(", ")))
    }
}

/// How a quaternion's four numbers are meant. Its reader takes them as x, y, z, w of the rotation of the
/// object's axes into the stream's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Quaternion {
    /// `xyzw`: just so.
    #[default]
    Xyzw,
    /// `wxyz`: w comes first, as Eigen's constructor, MAVLink and PX4 have it.
    Wxyz,
    /// `xyzw-inverse`: the conjugate, the stream's axes into the object's.
    XyzwInverse,
    /// `wxyz-inverse`: both.
    WxyzInverse,
}

impl Quaternion {
    /// Every way.
    pub const ALL: [Self; 4] = [Self::Xyzw, Self::Wxyz, Self::XyzwInverse, Self::WxyzInverse];

    /// Returns the name by which it is chosen.
    pub fn name(self) -> &'static str {
        ["xyzw", "wxyz", "xyzw-inverse", "wxyz-inverse"][self as usize]
    }

    /// Returns the rotation that is meant by four numbers as they came, taken as x, y, z, w.
    ///
    /// ```
    /// use glam::DQuat;
    /// use vizflyt_server::poses::settings::Quaternion;
    /// // A half turn about z is (0, 0, 1, 0), written with w first (0, 0, 0, 1).
    /// let came = DQuat::from_xyzw(0.0, 0.0, 0.0, 1.0);
    /// assert_eq!(Quaternion::Wxyz.rotation(came), DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0));
    /// ```
    pub fn rotation(self, came: DQuat) -> DQuat {
        let [a, b, c, d] = came.to_array();
        match self {
            Self::Xyzw => came,
            Self::Wxyz => DQuat::from_xyzw(b, c, d, a),
            Self::XyzwInverse => came.conjugate(),
            Self::WxyzInverse => DQuat::from_xyzw(-b, -c, -d, a),
        }
    }

    /// Returns the four numbers as they come for a rotation: the way back.
    pub fn streamed(self, rotation: DQuat) -> DQuat {
        let meant = match self {
            Self::Xyzw | Self::Wxyz => rotation,
            Self::XyzwInverse | Self::WxyzInverse => rotation.conjugate(),
        };
        match self {
            Self::Xyzw | Self::XyzwInverse => meant,
            Self::Wxyz | Self::WxyzInverse => DQuat::from_xyzw(meant.w, meant.x, meant.y, meant.z),
        }
    }
}

impl fmt::Display for Quaternion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Quaternion {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|quaternion| quaternion.name() == text);
        found.ok_or_else(|| format!("'{text}': write {}", Self::ALL.map(Self::name).join(", ")))
    }
}

/// How the object's own axes are laid in the vehicle, before `nose` turns them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BodyAxes {
    /// As the stream's lie in the room while it stands: that axis up that points up there, as a motion capture
    /// lays an object's axes when it is made.
    #[default]
    Stream,
    /// x forward, y left, z up, whatever the stream's axes.
    Flu,
    /// x forward, y right, z down, as autopilots have it, whatever the stream's axes.
    Frd,
}

impl BodyAxes {
    /// Every way.
    pub const ALL: [Self; 3] = [Self::Stream, Self::Flu, Self::Frd];
}

impl fmt::Display for BodyAxes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Stream => "stream",
            Self::Flu => "flu",
            Self::Frd => "frd",
        })
    }
}

/// Where the vehicle's nose points in the object's level axes: counter-clockwise from their x, seen from above.
/// `x`, `y`, `-x` and `-y` are 0, 90, 180 and -90 degrees.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Nose {
    deg: f64,
}

impl Nose {
    /// Those with a name, counter-clockwise from x.
    pub const NAMED: [Self; 4] =
        [Self { deg: 0.0 }, Self { deg: 90.0 }, Self { deg: 180.0 }, Self { deg: -90.0 }];

    /// Makes one from its angle. [deg]
    pub fn from_deg(deg: f64) -> Self {
        Self { deg }
    }

    /// Returns its angle. [deg]
    pub fn deg(self) -> f64 {
        self.deg
    }

    /// Returns the rotation of body axes into the object's level ones.
    pub fn object_from_body(self) -> DQuat {
        DQuat::from_rotation_z(self.deg.to_radians())
    }
}

impl fmt::Display for Nose {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let named = Self::NAMED.iter().position(|nose| nose == self);
        match named {
            Some(index) => f.write_str(["x", "y", "-x", "-y"][index]),
            None => write!(f, "{}", self.deg),
        }
    }
}

impl FromStr for Nose {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let named = Self::NAMED.into_iter().find(|nose| nose.to_string() == text);
        let read = || text.parse().ok().map(Self::from_deg);
        named.or_else(read).ok_or_else(|| format!("'{text}': {NOSE_IS}"))
    }
}

impl Serialize for Nose {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if Self::NAMED.contains(self) {
            serializer.collect_str(self)
        } else {
            serializer.serialize_f64(self.deg)
        }
    }
}

impl<'de> Deserialize<'de> for Nose {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(NoseVisitor)
    }
}

/// Reads a name or a number.
struct NoseVisitor;

impl serde::de::Visitor<'_> for NoseVisitor {
    type Value = Nose;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("x, y, -x, -y or degrees from the object's x")
    }

    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Nose, E> {
        text.parse().map_err(E::custom)
    }

    fn visit_f64<E: serde::de::Error>(self, deg: f64) -> Result<Nose, E> {
        Ok(Nose::from_deg(deg))
    }

    fn visit_i64<E: serde::de::Error>(self, deg: i64) -> Result<Nose, E> {
        Ok(Nose::from_deg(deg as f64))
    }
}

/// `offset`: where the stream's origin is in the world.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Offset {
    /// Where it is. [m, world]
    pub position_m: DVec3,
    /// How far its x axis is turned from the world's, counter-clockwise. [deg]
    pub yaw_deg: f64,
}

/// What takes a stream's numbers to poses; made by [`LocalizationConfig::alignment`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Alignment {
    /// Metres per unit of the stream. [m]
    pub unit_m: f64,
    /// The stream's axes.
    pub axes: Axes,
    /// How its quaternions are meant.
    pub quaternion: Quaternion,
    /// The object's axes.
    pub body: BodyAxes,
    /// The object's nose.
    pub nose: Nose,
    /// The stream's origin.
    pub offset: Offset,
    /// The tracked point. [m, body]
    pub pivot_m: DVec3,
}

impl Alignment {
    /// Returns where the vehicle is, given the object's position and the rotation of its axes into
    /// the stream's, both as streamed.
    ///
    /// ```
    /// use glam::{DQuat, DVec3};
    /// use vizflyt_server::poses::settings::LocalizationConfig;
    /// // Motive as installed, y up: 1 m up is y, and a turn to the left is one about y.
    /// let config = LocalizationConfig::parse("natnet:1.2.3.4,up=y").unwrap();
    /// let left = DQuat::from_rotation_y(0.5);
    /// let pose = config.alignment().world_from_body(DVec3::new(0.0, 1.0, 2.0), left);
    /// assert!((pose.translation_m - DVec3::new(0.0, -2.0, 1.0)).length() < 1e-12);
    /// assert!((pose.rotation.to_scaled_axis() - DVec3::Z * 0.5).length() < 1e-12);
    /// ```
    pub fn world_from_body(&self, p_stream: DVec3, stream_from_object: DQuat) -> Pose<World, Body> {
        let turn = DQuat::from_rotation_z(self.offset.yaw_deg.to_radians());
        let axes = self.axes.matrix();
        let p_m = turn * (axes * (p_stream * self.unit_m)) + self.offset.position_m;
        let stream_from_object = self.quaternion.rotation(stream_from_object);
        let world_from_level = match self.object_from_flu() {
            None => conjugated(axes, stream_from_object),
            Some(laid) => DQuat::from_mat3(&axes) * stream_from_object * laid,
        };
        let rotation = (turn * world_from_level * self.nose.object_from_body()).normalize();
        Pose::new(p_m - rotation * self.pivot_m, rotation)
    }

    /// Returns what was streamed: the way back.
    pub fn streamed(&self, pose: &Pose<World, Body>) -> (DVec3, DQuat) {
        let turn = DQuat::from_rotation_z(self.offset.yaw_deg.to_radians()).conjugate();
        let back = self.axes.matrix().transpose();
        let p_m = pose.translation_m + pose.rotation * self.pivot_m - self.offset.position_m;
        let rotation = turn * pose.rotation * self.nose.object_from_body().conjugate();
        let rotation = match self.object_from_flu() {
            None => conjugated(back, rotation),
            Some(laid) => DQuat::from_mat3(&back) * rotation * laid.conjugate(),
        };
        (back * (turn * p_m) / self.unit_m, self.quaternion.streamed(rotation))
    }

    /// Returns the matrix that takes vectors along the object's own axes to the body's.
    pub fn body_from_object(&self) -> DMat3 {
        let laid = match self.object_from_flu() {
            None => self.axes.matrix(),
            Some(laid) => DMat3::from_quat(laid.conjugate()),
        };
        DMat3::from_quat(self.nose.object_from_body().conjugate()) * laid
    }

    /// Returns the rotation of forward, left and up into the object's own axes where these are laid by name;
    /// `None` if as the stream's.
    fn object_from_flu(&self) -> Option<DQuat> {
        match self.body {
            BodyAxes::Stream => None,
            BodyAxes::Flu => Some(DQuat::IDENTITY),
            BodyAxes::Frd => Some(DQuat::from_rotation_x(std::f64::consts::PI)),
        }
    }
}

/// Returns a rotation as seen from axes that are exchanged, turned or mirrored.
fn conjugated(axes: DMat3, rotation: DQuat) -> DQuat {
    // The axis of a rotation is a pseudovector: a mirror turns the sense.
    let axis = axes.determinant() * (axes * rotation.xyz());
    DQuat::from_xyzw(axis.x, axis.y, axis.z, rotation.w)
}

impl LocalizationConfig {
    /// Makes a source with everything as usual.
    pub fn new(driver: Driver) -> Self {
        Self {
            driver,
            address: None,
            units: None,
            up: None,
            axes: None,
            euler: None,
            quaternion: Quaternion::default(),
            body: BodyAxes::default(),
            nose: Nose::default(),
            offset: Offset::default(),
            pivot_m: DVec3::ZERO,
            latency_ms: 0.0,
            objects: BTreeMap::new(),
            interface: None,
            sensor: None,
        }
    }

    /// Reads `DRIVER[:ADDRESS][,KEY=VALUE...]`, as the command line has it; keys and values are those
    /// of `[[localization]]`, lists in brackets: `pivot_m=[0.02,0,0.05]`.
    ///
    /// # Errors
    /// Says what is wrong, and what could stand there.
    pub fn parse(text: &str) -> Result<Self, String> {
        let (head, settings) = text.split_once(',').unwrap_or((text, ""));
        let (driver, address) = head.split_once(':').map_or((head, None), |(d, a)| (d, Some(a)));
        let mut table = toml::Table::new();
        table.insert("driver".to_owned(), driver.into());
        if let Some(address) = address {
            table.insert("address".to_owned(), address.into());
        }
        let mut settings = settings;
        while !settings.is_empty() {
            let (setting, rest) = first_setting(settings);
            settings = rest;
            if setting.is_empty() {
                continue;
            }
            let (key, value) = setting
                .split_once('=')
                .ok_or_else(|| format!("'{setting}': write KEY=VALUE, as units=mm"))?;
            let read = toml::Value::from_str(value).ok();
            if value.starts_with('[') && read.is_none() {
                return Err(format!("'{setting}': write a place as [x,y,z]"));
            }
            // Names are text even if they are numbers.
            let value = read
                .filter(|value| value.is_str() || !key.starts_with("objects."))
                .unwrap_or_else(|| value.into());
            insert(&mut table, key, value)?;
        }
        let config: Self = table.try_into().map_err(|error: toml::de::Error| {
            format!(
                "{}; write DRIVER:ADDRESS,KEY=VALUE; drivers are {}",
                error.message(),
                Driver::names()
            )
        })?;
        config.check("--pose").map_err(|error| error.to_string())?;
        Ok(config)
    }

    /// Returns where its stream arrives.
    pub fn address(&self) -> &str {
        self.address.as_deref().unwrap_or(self.driver.usual_address())
    }

    /// Returns the axes, given in either form.
    pub fn stream_axes(&self) -> Axes {
        self.axes.unwrap_or_else(|| self.up.map_or(Axes::IDENTITY, UpAxis::axes))
    }

    /// Returns what takes the stream's numbers to poses.
    pub fn alignment(&self) -> Alignment {
        Alignment {
            unit_m: self.units.unwrap_or(self.driver.usual_units()).metres(),
            axes: self.stream_axes(),
            quaternion: self.quaternion,
            body: self.body,
            nose: self.nose,
            offset: self.offset,
            pivot_m: self.pivot_m,
        }
    }

    /// Returns the name of a vehicle's object in the stream.
    pub fn object_of<'a>(&'a self, vehicle: &'a str) -> &'a str {
        self.objects.get(vehicle).map_or(vehicle, String::as_str)
    }

    fn check(&self, key: &str) -> Result<(), ConfigError> {
        if let (Some(_), Some(axes)) = (self.up, self.axes) {
            let advice = "`up` is a short form of `axes`: leave one of them out";
            return Err(invalid(format!("{key}.axes"), axes, advice));
        }
        let own = [
            ("euler", self.euler.map(|euler| euler.to_string())),
            ("interface", self.interface.map(|address| address.to_string())),
            ("sensor", self.sensor.map(|sensor| sensor.to_string())),
        ];
        for (name, value) in own {
            if let (Some(value), Some(advice)) = (value, self.driver.refuses(name)) {
                return Err(invalid(format!("{key}.{name}"), value, advice));
            }
        }
        if !self.driver.has_quaternions() && !is_default(&self.quaternion) {
            let advice = format!("{} has no quaternions whose order could differ", self.driver);
            return Err(invalid(format!("{key}.quaternion"), self.quaternion, advice));
        }
        if self.body != BodyAxes::Stream && self.stream_axes().is_mirror() {
            let advice = "a mirrored stream has no such axes: leave `body` out, or mend `axes`";
            return Err(invalid(format!("{key}.body"), self.body, advice));
        }
        check_number(&format!("{key}.nose"), self.nose.deg(), "degrees", -360.0..=360.0)?;
        check_position(&format!("{key}.offset.position_m"), self.offset.position_m)?;
        check_position(&format!("{key}.pivot_m"), self.pivot_m)?;
        check_number(&format!("{key}.latency_ms"), self.latency_ms, "ms", 0.0..=500.0)?;
        check_number(
            &format!("{key}.offset.yaw_deg"),
            self.offset.yaw_deg,
            "degrees",
            -360.0..=360.0,
        )
    }
}

/// Cuts the first setting off several, KEY=VALUE and commas: those within a list's brackets, or quotes, part nothing.
fn first_setting(settings: &str) -> (&str, &str) {
    let value = settings.find('=').map_or(settings.len(), |equals| equals + 1);
    let within = match settings[value..].chars().next() {
        // Of nested lists nothing is made: no setting is one.
        Some('[') => Some(settings[value..].find(']').unwrap_or(settings.len() - value)),
        Some(quote @ ('"' | '\'')) => settings[value + 1..].find(quote).map(|end| end + 1),
        _ => None,
    };
    // Before the sign there may be a comma still: of a setting without a value.
    let comma = settings[..value].find(',');
    let comma = comma.or_else(|| {
        let from = value + within.unwrap_or(0);
        settings[from..].find(',').map(|place| from + place)
    });
    comma.map_or((settings, ""), |comma| (&settings[..comma], &settings[comma + 1..]))
}

/// Puts a value under a key of one or several parts: `offset.yaw_deg`.
fn insert(table: &mut toml::Table, key: &str, value: toml::Value) -> Result<(), String> {
    let Some((outer, inner)) = key.split_once('.') else {
        table.insert(key.to_owned(), value);
        return Ok(());
    };
    let inside = table.entry(outer).or_insert_with(|| toml::Table::new().into());
    let inside = inside.as_table_mut().ok_or_else(|| format!("'{outer}' is no table"))?;
    insert(inside, inner, value)
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// The part of `arena.toml` that is read here; the rest is the arena's.
#[derive(Deserialize)]
struct ArenaToml {
    #[serde(default)]
    localization: Vec<LocalizationConfig>,
}

/// Reads every `[[localization]]` of the text of an `arena.toml`.
///
/// # Errors
/// Points at the line: unknown keys, values that cannot work, more than [`MAX_SOURCES`].
pub fn read_all(arena_toml: &str) -> Result<Vec<LocalizationConfig>, ConfigError> {
    let ArenaToml { localization } = vizflyt_toml::parse(arena_toml)?;
    check_all(&localization).map_err(|error| error.in_text(arena_toml))?;
    Ok(localization)
}

fn check_all(sources: &[LocalizationConfig]) -> Result<(), ConfigError> {
    if sources.len() > MAX_SOURCES {
        let advice = format!("give at most {MAX_SOURCES} [[localization]]");
        return Err(invalid("localization", format!("{} of them", sources.len()), advice));
    }
    let mut sources = sources.iter().enumerate();
    sources.try_for_each(|(index, source)| source.check(&format!("localization[{index}]")))
}

/// Returns the sources of poses of an arena, by its file or folder; a bare scene names none.
///
/// # Errors
/// A file that cannot be read, or as [`read_all`].
pub fn of_arena(path: &Path) -> Result<Vec<LocalizationConfig>> {
    let Some((path, text)) = scene::arena_text(path)? else { return Ok(Vec::new()) };
    read_all(&text).with_context(|| format!("{} is wrong", path.display()))
}

/// What a nose may be.
const NOSE_IS: &str = "write x, y, -x, -y or degrees from the object's x";
/// Sources of one server at most.
pub const MAX_SOURCES: usize = 8;

#[cfg(test)]
mod tests;
