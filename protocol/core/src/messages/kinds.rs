//! Kinds of setpoint that a course allows.

use core::fmt;

use serde::de::{Deserializer, SeqAccess, Visitor};
use serde::ser::{SerializeSeq, Serializer};
use serde::{Deserialize, Serialize};

use super::Setpoint;

/// Kind of setpoint. Hold, land and take-off setpoints are always allowed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SetpointKind {
    /// A point in the world.
    Position,
    /// A velocity.
    Velocity,
    /// An acceleration.
    Acceleration,
    /// A point relative to the vehicle.
    Offset,
    /// Body rates and thrust.
    AttitudeRate,
    /// Waypoints or polynomials.
    Trajectory,
}

impl SetpointKind {
    /// All kinds.
    pub const ALL: [Self; 6] = [
        Self::Position,
        Self::Velocity,
        Self::Acceleration,
        Self::Offset,
        Self::AttitudeRate,
        Self::Trajectory,
    ];

    /// Returns the kind of a setpoint; `None` if it is always allowed.
    pub fn of(setpoint: &Setpoint) -> Option<Self> {
        match setpoint {
            Setpoint::Hold | Setpoint::Land | Setpoint::TakeOff => None,
            Setpoint::Position { .. } => Some(Self::Position),
            Setpoint::Velocity { .. } => Some(Self::Velocity),
            Setpoint::Acceleration { .. } => Some(Self::Acceleration),
            Setpoint::Offset { .. } => Some(Self::Offset),
            Setpoint::AttitudeRate { .. } => Some(Self::AttitudeRate),
            Setpoint::Trajectory(_) => Some(Self::Trajectory),
        }
    }

    /// Returns the name, as in `arena.toml`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Position => "position",
            Self::Velocity => "velocity",
            Self::Acceleration => "acceleration",
            Self::Offset => "offset",
            Self::AttitudeRate => "attitude_rate",
            Self::Trajectory => "trajectory",
        }
    }
}

/// Set of kinds of setpoint. In files, a list of their names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SetpointKinds(u8);

impl SetpointKinds {
    /// The empty set: only setpoints that are always allowed.
    pub const NONE: Self = Self(0);
    /// Default of a course: all kinds except attitude rates.
    pub const USUAL: Self = Self(0b10_1111);
    /// Default of a course that withholds the pose: kinds that do not need a position in the world.
    pub const BY_OWN_SENSES: Self = Self(0b10_1110);
    /// All kinds.
    pub const ALL: Self = Self(0b11_1111);

    /// Returns the set with `kind` added.
    ///
    /// ```
    /// use vizflyt_protocol::messages::{SetpointKind, SetpointKinds};
    /// assert_eq!(SetpointKinds::USUAL.with(SetpointKind::AttitudeRate), SetpointKinds::ALL);
    /// assert!(!SetpointKinds::USUAL.contains(SetpointKind::AttitudeRate));
    /// ```
    #[must_use]
    pub const fn with(self, kind: SetpointKind) -> Self {
        Self(self.0 | 1 << kind as u8)
    }

    /// Whether the set contains a kind.
    pub const fn contains(self, kind: SetpointKind) -> bool {
        self.0 & 1 << kind as u8 != 0
    }

    /// Whether a setpoint is allowed.
    pub fn allow(self, setpoint: &Setpoint) -> bool {
        SetpointKind::of(setpoint).is_none_or(|kind| self.contains(kind))
    }

    /// Returns the kinds in the set.
    pub fn iter(self) -> impl Iterator<Item = SetpointKind> {
        SetpointKind::ALL.into_iter().filter(move |&kind| self.contains(kind))
    }
}

impl FromIterator<SetpointKind> for SetpointKinds {
    fn from_iter<I: IntoIterator<Item = SetpointKind>>(kinds: I) -> Self {
        kinds.into_iter().fold(Self::NONE, Self::with)
    }
}

/// Writes the names, separated by commas.
impl fmt::Display for SetpointKinds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, kind) in self.iter().enumerate() {
            write!(f, "{}{}", if index == 0 { "" } else { ", " }, kind.name())?;
        }
        if *self == Self::NONE { f.write_str("none") } else { Ok(()) }
    }
}

impl Serialize for SetpointKinds {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut list = serializer.serialize_seq(Some(self.iter().count()))?;
        for kind in self.iter() {
            list.serialize_element(&kind)?;
        }
        list.end()
    }
}

impl<'de> Deserialize<'de> for SetpointKinds {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct List;

        impl<'de> Visitor<'de> for List {
            type Value = SetpointKinds;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a list of kinds of setpoint")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Self::Value, A::Error> {
                let mut kinds = SetpointKinds::NONE;
                while let Some(kind) = list.next_element()? {
                    kinds = kinds.with(kind);
                }
                Ok(kinds)
            }
        }

        deserializer.deserialize_seq(List)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use proptest::prelude::*;

    use std::string::ToString;

    use super::*;

    #[test]
    fn parses_the_names_used_in_files() {
        let kinds: SetpointKinds = serde_json::from_str(r#"["velocity", "position"]"#).unwrap();
        assert_eq!(kinds, [SetpointKind::Position, SetpointKind::Velocity].into_iter().collect());
        assert_eq!(kinds.to_string(), "position, velocity");
        assert_eq!(SetpointKinds::NONE.to_string(), "none");
        let error = serde_json::from_str::<SetpointKinds>(r#"["speed"]"#).unwrap_err();
        assert!(error.to_string().contains("`velocity`"), "{error}");
        for kind in SetpointKind::ALL {
            let text = serde_json::to_string(&kind).unwrap();
            assert_eq!(text.trim_matches('"'), kind.name());
        }
        assert!(SetpointKinds::NONE.allow(&Setpoint::Land));
    }

    proptest! {
        #[test]
        fn survives_serialization(bits in 0_u8..0b100_0000) {
            let kinds = SetpointKinds(bits);
            let mut buffer = [0; 16];
            let bytes = postcard::to_slice(&kinds, &mut buffer).unwrap();
            prop_assert_eq!(postcard::from_bytes::<SetpointKinds>(bytes), Ok(kinds));
        }
    }
}
