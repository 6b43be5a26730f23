//! Conventions of a stream: units, axes, rotations, and the orientation of the tracked object in the vehicle.

use std::fmt;
use std::str::FromStr;

use glam::{DMat3, DQuat, DVec3, EulerRot};
use serde::{Deserialize, Serialize};

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
    pub const ALL: [Self; 3] = [Self::Metres, Self::Centimetres, Self::Millimetres];

    /// Returns the metres per unit. [m]
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

/// Axis of a stream that points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpAxis {
    /// As in the world.
    Z,
    /// Default of Motive: x right, y up, z towards the viewer.
    Y,
}

impl UpAxis {
    pub fn axes(self) -> Axes {
        match self {
            Self::Z => Axes::IDENTITY,
            Self::Y => Axes([(0, false), (2, true), (1, false)]),
        }
    }
}

/// Axes of the stream that correspond to the world's x, y and z, each possibly reversed. `x-zy` means that the
/// world's y is the stream's -z, and its z the stream's y.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Axes([(usize, bool); 3]);

impl Axes {
    /// `xyz`: the stream's axes equal the world's.
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

    /// Returns the matrix from the stream's coordinates to the world's.
    pub fn matrix(self) -> DMat3 {
        let mut rows = [DVec3::ZERO; 3];
        for (row, (axis, turned)) in rows.iter_mut().zip(self.0) {
            row[axis] = if turned { -1.0 } else { 1.0 };
        }
        DMat3::from_cols(rows[0], rows[1], rows[2]).transpose()
    }

    /// Returns whether the axes are a mirror image.
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

/// Convention of three angles about x, y and z.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Euler {
    /// `xyz`: first about the fixed x, then the fixed y, then the fixed z: `Rz Ry Rx`.
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
    /// `zyx`: `Rx Ry Rz`, the same as rotations about the object's own x, then y, then z.
    Zyx,
    /// `vector`: rotation vector; its length is the angle.
    Vector,
}

impl Euler {
    pub const ALL: [Self; 7] =
        [Self::Xyz, Self::Xzy, Self::Yxz, Self::Yzx, Self::Zxy, Self::Zyx, Self::Vector];

    /// Returns the name of the setting.
    pub fn name(self) -> &'static str {
        ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "vector"][self as usize]
    }

    /// Returns the same order for glam, which uses moving axes, so in reverse.
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

    /// Returns the axes of the first, second and third rotation in glam's order, as indices of x, y and z.
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

/// Convention of a quaternion's four numbers. The parser reads them as x, y, z, w of the rotation from the
/// object's axes to the stream's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Quaternion {
    /// `xyzw`: no conversion.
    #[default]
    Xyzw,
    /// `wxyz`: w comes first, as in Eigen's constructor, MAVLink and PX4.
    Wxyz,
    /// `xyzw-inverse`: the conjugate, from the stream's axes to the object's.
    XyzwInverse,
    /// `wxyz-inverse`: both.
    WxyzInverse,
}

impl Quaternion {
    pub const ALL: [Self; 4] = [Self::Xyzw, Self::Wxyz, Self::XyzwInverse, Self::WxyzInverse];

    /// Returns the name of the setting.
    pub fn name(self) -> &'static str {
        ["xyzw", "wxyz", "xyzw-inverse", "wxyz-inverse"][self as usize]
    }

    /// Returns the rotation for four received numbers, which were read as x, y, z, w.
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

    /// Returns the four numbers to receive for a rotation: the inverse of [`Self::rotation`].
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

/// Orientation of the object's own axes in the vehicle, before `nose` turns them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BodyAxes {
    /// Parallel to the stream's axes while the vehicle stands: the stream's up axis is also the object's.
    /// Motion capture systems define an object's axes in this way.
    #[default]
    Stream,
    /// x forward, y left, z up, for any axes of the stream.
    Flu,
    /// x forward, y right, z down, as in autopilots, for any axes of the stream.
    Frd,
}

impl BodyAxes {
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

/// Direction of the vehicle's nose in the object's level axes, counter-clockwise from their x, seen from above.
/// `x`, `y`, `-x` and `-y` are 0, 90, 180 and -90 degrees; any other angle is a number of degrees.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Nose {
    deg: f64,
}

impl Nose {
    /// Named directions, counter-clockwise from x.
    pub const NAMED: [Self; 4] =
        [Self { deg: 0.0 }, Self { deg: 90.0 }, Self { deg: 180.0 }, Self { deg: -90.0 }];

    /// Creates a direction from its angle. [deg]
    pub fn from_deg(deg: f64) -> Self {
        Self { deg }
    }

    pub fn deg(self) -> f64 {
        self.deg
    }

    /// Returns the rotation from body axes to the object's level axes.
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

/// Parses a name or a number.
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

/// Valid values of a nose.
const NOSE_IS: &str = "write x, y, -x, -y or degrees from the object's x";
