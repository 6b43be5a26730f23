//! Registry of pose drivers: names and default settings. [`crate::poses::drivers`] opens the socket of each
//! driver and parses its stream.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Units;

/// Sender of poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Driver {
    /// Vicon Tracker's UDP object stream.
    Vicon,
    /// OptiTrack Motive's NatNet 3 and 4.
    Natnet,
    /// VizFlyt's own pose packet: JSON over UDP, from any program.
    Json,
    /// The autopilot's own estimate over MAVLink.
    Mavlink,
    /// Any server of the Virtual-Reality Peripheral Network, over TCP.
    Vrpn,
}

/// Properties of a driver.
struct Entry {
    driver: Driver,
    name: &'static str,
    usual_address: &'static str,
    usual_units: Units,
    /// Keys of `[[localization]]` that only this driver has, with the reason.
    own_keys: &'static [(&'static str, &'static str)],
}

/// Entries in the order of the variants.
const REGISTRY: [Entry; 5] = [
    Entry {
        driver: Driver::Vicon,
        name: "vicon",
        usual_address: "0.0.0.0:51001",
        usual_units: Units::Millimetres,
        own_keys: &[("euler", "only Vicon streams angles; the others stream quaternions")],
    },
    Entry {
        driver: Driver::Natnet,
        name: "natnet",
        // Motive's default multicast group and data port.
        usual_address: "239.255.42.99:1511",
        usual_units: Units::Metres,
        own_keys: &[(
            "interface",
            "only NatNet comes by multicast; for others, put it into `address`",
        )],
    },
    Entry {
        driver: Driver::Json,
        name: "json",
        usual_address: "0.0.0.0:51002",
        usual_units: Units::Metres,
        own_keys: &[],
    },
    Entry {
        driver: Driver::Mavlink,
        name: "mavlink",
        usual_address: "0.0.0.0:14560",
        usual_units: Units::Metres,
        own_keys: &[],
    },
    Entry {
        driver: Driver::Vrpn,
        name: "vrpn",
        // The client connects to a server, by default on this computer.
        usual_address: "127.0.0.1:3883",
        usual_units: Units::Metres,
        own_keys: &[("sensor", "only VRPN's trackers have sensors")],
    },
];

impl Driver {
    pub fn all() -> impl Iterator<Item = Self> {
        REGISTRY.iter().map(|entry| entry.driver)
    }

    /// Returns the names of all drivers, for help and errors: `vicon, natnet`.
    pub fn names() -> String {
        Self::all().map(Self::name).collect::<Vec<_>>().join(", ")
    }

    fn entry(self) -> &'static Entry {
        // The registry is in the order of the variants; a test checks this.
        &REGISTRY[self as usize]
    }

    /// Returns the name of the setting.
    pub fn name(self) -> &'static str {
        self.entry().name
    }

    /// Returns the default address at which its stream arrives, or is requested.
    pub fn usual_address(self) -> &'static str {
        self.entry().usual_address
    }

    /// Returns the driver's default length unit.
    pub fn usual_units(self) -> Units {
        self.entry().usual_units
    }

    /// Returns whether the order of its quaternions depends on the sender; MAVLink's is standardized.
    pub fn has_quaternions(self) -> bool {
        !matches!(self, Self::Vicon | Self::Mavlink)
    }

    /// Returns why a key of `[[localization]]` is invalid for this driver; `None` if it is valid.
    pub(super) fn refuses(self, key: &str) -> Option<&'static str> {
        let mut owned = REGISTRY.iter().flat_map(|entry| {
            entry.own_keys.iter().map(|&(own, reason)| (entry.driver, own, reason))
        });
        let (driver, _, reason) = owned.find(|(_, own, _)| *own == key)?;
        (driver != self).then_some(reason)
    }
}

impl fmt::Display for Driver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn registry_and_guide_list_every_driver_once() {
        let guide = include_str!("../../../../../docs/guides/localization.md");
        for (index, driver) in Driver::all().enumerate() {
            assert_eq!(driver as usize, index);
            assert_eq!(toml::Value::try_from(driver).unwrap().as_str(), Some(driver.name()));
            assert!(guide.contains(&format!("`{driver}`")), "the guide does not name `{driver}`");
        }
    }
}
