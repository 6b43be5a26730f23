//! Dangerous values in a room, and contradictions between values. Names and units are the newest ones.

use std::collections::BTreeMap;

/// Values by newest name, in newest units.
pub(super) type Values = BTreeMap<&'static str, f64>;

/// Parameter that can make a flight in a room dangerous.
#[derive(Clone, Copy)]
pub struct Rule {
    /// Newest name.
    pub name: &'static str,
    /// Returns the danger of a value, if it is dangerous.
    pub danger: fn(f64) -> Option<&'static str>,
}

/// Effect of a return to launch in a room.
const RETURNS: &str =
    "the vehicle returns to launch: it climbs to RTL_ALT_M first, into the ceiling";

/// Rules, most dangerous first.
pub const RULES: &[Rule] = &[
    Rule {
        name: "FS_GCS_ENABLE",
        danger: |value| match value as i32 {
            5 => None,
            0 => Some("nothing happens when the runtime or its link is lost: the vehicle flies on"),
            _ => Some(
                "when the runtime or its link is lost, it may return to launch: it climbs to \
                       RTL_ALT_M first, into the ceiling; 5 lands",
            ),
        },
    },
    Rule {
        name: "MAV_GCS_SYSID",
        danger: |value| {
            (value != 255.0)
                .then_some("the ground station failsafe does not count the runtime's heartbeats")
        },
    },
    Rule {
        name: "FS_EKF_ACTION",
        danger: |value| match value as i32 {
            1 | 3 => None,
            0 => Some(
                "nothing happens when the estimator loses its position: the vehicle drifts away",
            ),
            _ => Some(
                "when the estimator loses its position the vehicle holds its height and drifts away",
            ),
        },
    },
    Rule { name: "FS_DR_ENABLE", danger: |value| matches!(value as i32, 2 | 3).then_some(RETURNS) },
    Rule {
        name: "BATT_MONITOR",
        danger: |value| {
            (value == 0.0).then_some("the battery is not watched: it runs empty in flight")
        },
    },
    Rule { name: "BATT_FS_LOW_ACT", danger: battery_action },
    Rule { name: "BATT_FS_CRT_ACT", danger: battery_action },
    Rule {
        name: "FENCE_ENABLE",
        danger: |value| {
            (value == 0.0).then_some(
                "the autopilot has no fence: nothing holds a vehicle that the runtime lost",
            )
        },
    },
    Rule {
        name: "FENCE_ACTION",
        danger: |value| match value as i32 {
            2 | 4 => None,
            0 => Some("a vehicle that leaves the fence is only reported"),
            _ => Some(
                "a vehicle that leaves the fence may return to launch: it climbs to RTL_ALT_M first, into \
                       the ceiling; 2 lands",
            ),
        },
    },
    Rule {
        name: "FENCE_TYPE",
        danger: |value| {
            (value as i32 & POLYGONS == 0).then_some(
                "the fence is round: it holds neither the room's walls nor its no-fly boxes",
            )
        },
    },
    Rule {
        name: "FENCE_ALT_MAX",
        danger: |value| (value > 10.0).then_some("the fence ends far above any room's ceiling"),
    },
    Rule {
        name: "FENCE_RADIUS",
        danger: |value| (value > 50.0).then_some("the fence ends far beyond any room's walls"),
    },
    Rule {
        name: "RTL_ALT_M",
        danger: |value| {
            (value > 3.0)
                .then_some("a return to launch, by a pilot's switch too, climbs this high first")
        },
    },
    Rule {
        name: "FS_THR_ENABLE",
        danger: |value| {
            matches!(value as i32, 1 | 2 | 4 | 6).then_some(
            "when the transmitter is lost the vehicle returns to launch: it climbs to RTL_ALT_M first, into the \
             ceiling; 3 lands",
        )
        },
    },
    Rule {
        name: "ARMING_SKIPCHK",
        danger: |value| (value != 0.0).then_some("checks before arming are left out"),
    },
    Rule {
        name: "FS_CRASH_CHECK",
        danger: |value| (value == 0.0).then_some("the motors go on turning after a crash"),
    },
    Rule {
        name: "WP_YAW_BEHAVIOR",
        danger: |value| {
            (value != 0.0).then_some("the nose turns by itself, and with it the cameras")
        },
    },
    Rule {
        name: "GUID_TIMEOUT",
        danger: |value| {
            (value > 1.0).then_some("the vehicle coasts this long after the last velocity setpoint")
        },
    },
    Rule { name: "PSC_JERK_NE", danger: brakes_late },
    Rule { name: "PSC_JERK_D", danger: brakes_late },
    Rule { name: "ATC_RAT_RLL_P", danger: oscillates },
    Rule { name: "ATC_RAT_PIT_P", danger: oscillates },
    Rule {
        name: "VISO_TYPE",
        danger: |value| (value != 1.0).then_some("poses of the localization are not used"),
    },
    Rule { name: "EK3_SRC1_POSXY", danger: not_external },
    Rule { name: "EK3_SRC1_VELXY", danger: not_external },
    Rule { name: "EK3_SRC1_POSZ", danger: not_external },
    Rule { name: "EK3_SRC1_VELZ", danger: not_external },
    Rule { name: "EK3_SRC1_YAW", danger: not_external },
];

/// With 5 m/s^3, ArduCopter's default, a velocity follows its setpoint after 0.7 s; with 20, after 0.3 s, which the
/// runtime's guard assumes (4.8.0-dev, software in the loop).
fn brakes_late(value: f64) -> Option<&'static str> {
    (value < 20.0).then_some(
        "the vehicle answers and brakes late: the runtime flies it at a part of the speed limit, so that it stops \
         before the net",
    )
}

/// Applied only while the gain is ArduCopter's default: a tuned gain may be as high.
fn oscillates(value: f64) -> Option<&'static str> {
    (value > 0.1).then_some(
        "ArduCopter's own gain: a vehicle this light and strong may oscillate at its first take-off",
    )
}

/// Bit of FENCE_TYPE: inclusion and exclusion polygons.
const POLYGONS: i32 = 4;

fn battery_action(value: f64) -> Option<&'static str> {
    match value as i32 {
        1 | 7 => None,
        0 => Some("nothing happens when the battery is low: it runs empty in flight"),
        5 => Some("when the battery is low the motors stop in flight; 1 lands"),
        _ => Some(
            "when the battery is low the vehicle may return to launch: it climbs to RTL_ALT_M first, into \
                   the ceiling; 1 lands",
        ),
    }
}

fn not_external(value: f64) -> Option<&'static str> {
    (value != 6.0).then_some("the estimator does not navigate only by the localization's poses")
}

/// Returns the contradictions between values by newest name, one sentence each.
pub fn contradictions(values: &Values) -> Vec<String> {
    let mut found = Vec::new();
    let get = |name: &str| values.get(name).copied();
    let mut check = |wrong: Option<bool>, text: &str| {
        if wrong == Some(true) {
            found.push(text.to_owned());
        }
    };
    let both = |a: Option<f64>, b: Option<f64>, wrong: fn(f64, f64) -> bool| {
        a.zip(b).map(|(a, b)| wrong(a, b))
    };
    let external = ["POSXY", "VELXY", "POSZ", "VELZ", "YAW"]
        .map(|axis| get(&format!("EK3_SRC1_{axis}")))
        .contains(&Some(6.0));
    check(
        get("VISO_TYPE").map(|kind| external && kind == 0.0),
        "EK3_SRC1_* = 6 needs external navigation, but VISO_TYPE = 0",
    );
    check(
        get("EK3_SRC1_POSXY")
            .zip(get("GPS1_TYPE"))
            .map(|(source, gps)| source == 3.0 && gps == 0.0),
        "EK3_SRC1_POSXY = 3 needs a GPS, but GPS1_TYPE = 0",
    );
    check(
        both(get("EK3_SRC1_YAW"), get("COMPASS_ENABLE"), |yaw, compass| {
            yaw == 1.0 && compass == 0.0
        }),
        "EK3_SRC1_YAW = 1 needs a compass, but COMPASS_ENABLE = 0",
    );
    check(
        both(get("AHRS_EKF_TYPE"), get("EK3_ENABLE"), |kind, on| kind == 3.0 && on == 0.0),
        "AHRS_EKF_TYPE = 3 needs EK3_ENABLE = 1",
    );
    check(
        both(get("BATT_LOW_VOLT"), get("BATT_CRT_VOLT"), |low, critical| low <= critical),
        "BATT_LOW_VOLT must be above BATT_CRT_VOLT",
    );
    check(
        both(get("BATT_ARM_VOLT"), get("BATT_LOW_VOLT"), |arm, low| arm > 0.0 && arm <= low),
        "BATT_ARM_VOLT must be above BATT_LOW_VOLT: it would land at once",
    );
    check(
        both(get("BATT_LOW_MAH"), get("BATT_CRT_MAH"), |low, critical| low < critical),
        "BATT_LOW_MAH must be above BATT_CRT_MAH",
    );
    check(
        both(get("BATT_LOW_MAH"), get("BATT_CAPACITY"), |low, all| low >= all && low > 0.0),
        "BATT_LOW_MAH must be below BATT_CAPACITY",
    );
    check(
        get("BATT_MONITOR").map(|monitor| {
            monitor == 0.0 && get("BATT_FS_LOW_ACT").is_some_and(|action| action != 0.0)
        }),
        "BATT_FS_LOW_ACT needs a monitor, but BATT_MONITOR = 0",
    );
    check(
        both(get("MOT_SPIN_ARM"), get("MOT_SPIN_MIN"), |arm, min| arm > min),
        "MOT_SPIN_ARM must not be above MOT_SPIN_MIN",
    );
    check(
        both(get("MOT_BAT_VOLT_MIN"), get("MOT_BAT_VOLT_MAX"), |low, high| low >= high),
        "MOT_BAT_VOLT_MIN must be below MOT_BAT_VOLT_MAX",
    );
    check(
        both(get("FENCE_MARGIN"), get("FENCE_RADIUS"), |margin, radius| margin >= radius),
        "FENCE_MARGIN must be below FENCE_RADIUS",
    );
    let height = get("FENCE_ALT_MAX").zip(get("FENCE_ALT_MIN")).map(|(most, least)| most - least);
    check(
        both(height, get("FENCE_MARGIN"), |height, margin| height <= 2.0 * margin),
        "FENCE_ALT_MAX and FENCE_ALT_MIN must be more than twice FENCE_MARGIN apart",
    );
    check(
        both(get("RTL_ALT_M"), get("FENCE_ALT_MAX"), |rtl, fence| rtl >= fence),
        "RTL_ALT_M must be below FENCE_ALT_MAX",
    );
    check(
        both(get("FENCE_ENABLE"), get("FENCE_TYPE"), |on, kind| on != 0.0 && kind == 0.0),
        "FENCE_ENABLE = 1 needs a FENCE_TYPE",
    );
    check(
        both(get("FENCE_TYPE"), get("FENCE_ENABLE"), |kind, on| on != 0.0 && kind as i32 & 1 == 0),
        "FENCE_TYPE without bit 0 has no ceiling",
    );
    check(
        both(get("FS_THR_ENABLE"), get("FS_THR_VALUE"), |on, value| on != 0.0 && value < 925.0),
        "FS_THR_VALUE below 925 does not detect a transmitter that is off",
    );
    found
}
