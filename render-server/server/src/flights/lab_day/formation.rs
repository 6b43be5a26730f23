//! Several vehicles at once: order of take-off, and separation in the air. Pure.

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Order of take-off.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TakeOffOrder {
    /// Names of the vehicles, first to last; empty means no order.
    pub vehicles: Vec<String>,
    /// Condition for the preceding vehicle.
    pub until: Until,
}

/// Condition for the preceding vehicle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Until {
    /// Its take-off is complete: all fly together.
    #[default]
    Up,
    /// It has landed: one flies after the other.
    Landed,
}

/// Progress of a vehicle's flight.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stand {
    /// Before or during take-off.
    Below,
    /// Take-off complete.
    Up,
    /// Flown and landed.
    Landed,
}

impl TakeOffOrder {
    /// Checks that the order contains only vehicles of `known`, each once.
    ///
    /// # Errors
    /// The wrong name, and the valid ones.
    pub fn check(&self, known: &[&str]) -> Result<(), String> {
        for (at, name) in self.vehicles.iter().enumerate() {
            if !known.contains(&name.as_str()) {
                return Err(format!(
                    "there is no vehicle '{name}'; there are {}",
                    known.join(", ")
                ));
            }
            if self.vehicles[..at].contains(name) {
                return Err(format!("'{name}' is twice in the order of take-off; name it once"));
            }
        }
        Ok(())
    }

    /// Checks whether `vehicle` may take off; `stand` returns the progress of the others.
    ///
    /// # Errors
    /// Why not yet, and what to do.
    pub fn may_start(&self, vehicle: &str, stand: impl Fn(&str) -> Stand) -> Result<(), String> {
        if self.vehicles.is_empty() {
            return Ok(());
        }
        let order = self.vehicles.join(", ");
        let Some(at) = self.vehicles.iter().position(|name| name == vehicle) else {
            return Err(format!(
                "'{vehicle}' is not in the order of take-off ({order}): add it on the page /lab"
            ));
        };
        let Some(before) = at.checked_sub(1).and_then(|before| self.vehicles.get(before)) else {
            return Ok(());
        };
        let (is_there, what) = match (self.until, stand(before)) {
            (Until::Up, Stand::Up) | (_, Stand::Landed) => (true, ""),
            (Until::Up, Stand::Below) => (false, "is not up yet"),
            (Until::Landed, _) => (false, "has not landed yet"),
        };
        if is_there {
            return Ok(());
        }
        Err(format!(
            "'{before}' goes before '{vehicle}' ({order}) and {what}; start it first, or change the order on the \
             page /lab"
        ))
    }
}

/// Vehicle in the air.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Airborne {
    /// Index of the vehicle.
    pub vehicle: usize,
    /// Position of its centre. [m, world]
    pub p_world_m: DVec3,
    /// Time of its take-off. [s]
    pub took_off_s: f64,
}

/// Two vehicles that are too close.
#[derive(Clone, Debug, PartialEq)]
pub struct TooClose {
    /// Index of the one that took off first.
    pub first: usize,
    /// Index of the one that took off later.
    pub later: usize,
    /// Distance between their centres. [m]
    pub apart_m: f64,
    /// Vehicles to land.
    pub land: Vec<usize>,
}

/// Monitors the separation of vehicles in the air.
///
/// Of two vehicles that come too close, the one that took off later is landed. If both braked and sank next to
/// each other, the distance would not grow, while the first one continues on its path and leaves. If the
/// distance still falls below half of the minimum, the first is landed, too.
#[derive(Clone, Debug, Default)]
pub struct SeparationWatch {
    /// Pairs already reported: first, later, and whether both were landed.
    told: Vec<(usize, usize, bool)>,
}

impl SeparationWatch {
    /// Returns the pairs that have come too close since the last call. `least_m` is the minimum distance
    /// between centres.
    pub fn judge(&mut self, least_m: f64, airborne: &[Airborne]) -> Vec<TooClose> {
        let mut found = Vec::new();
        self.told.retain(|(first, later, _)| {
            let is_up = |vehicle| airborne.iter().find(|a| a.vehicle == vehicle);
            // Dropped when they are apart again by a margin, or on the ground.
            is_up(*first).zip(is_up(*later)).is_some_and(|(a, b)| apart_m(a, b) < least_m * AGAIN)
        });
        for (at, a) in airborne.iter().enumerate() {
            for b in &airborne[at + 1..] {
                let apart_m = apart_m(a, b);
                if apart_m >= least_m {
                    continue;
                }
                let b_is_later = (b.took_off_s, b.vehicle) > (a.took_off_s, a.vehicle);
                let (first, later) =
                    if b_is_later { (a.vehicle, b.vehicle) } else { (b.vehicle, a.vehicle) };
                let is_half = apart_m < 0.5 * least_m;
                let land =
                    match self.told.iter_mut().find(|told| (told.0, told.1) == (first, later)) {
                        Some((.., both)) if is_half && !*both => {
                            *both = true;
                            vec![first]
                        }
                        Some(_) => continue,
                        None => {
                            self.told.push((first, later, is_half));
                            if is_half { vec![later, first] } else { vec![later] }
                        }
                    };
                found.push(TooClose { first, later, apart_m, land });
            }
        }
        found
    }
}

pub fn apart_m(a: &Airborne, b: &Airborne) -> f64 {
    a.p_world_m.distance(b.p_world_m)
}

/// Factor of the separation that a pair must reach before it is reported again.
const AGAIN: f64 = 1.2;
/// Valid range of the separation. [m]
pub const SEPARATION_M: std::ops::RangeInclusive<f64> = 0.2..=20.0;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn order(names: &[&str], until: Until) -> TakeOffOrder {
        TakeOffOrder { vehicles: names.iter().map(ToString::to_string).collect(), until }
    }

    #[test]
    fn each_waits_for_the_preceding_vehicle() {
        let check = |until, vehicle: &str, before: Stand, expected: Option<&str>| {
            let found = order(&["wasp", "bee", "ant"], until).may_start(vehicle, |_| before);
            assert_eq!(found.as_ref().err().map(String::as_str), expected, "{vehicle} {before:?}");
        };
        check(Until::Up, "wasp", Stand::Below, None);
        check(
            Until::Up,
            "bee",
            Stand::Below,
            Some(
                "'wasp' goes before 'bee' (wasp, bee, ant) and is not up yet; start it first, or change the order on \
                 the page /lab",
            ),
        );
        check(Until::Up, "bee", Stand::Up, None);
        check(Until::Up, "bee", Stand::Landed, None);
        let late =
            order(&["wasp", "bee"], Until::Landed).may_start("bee", |_| Stand::Up).unwrap_err();
        assert!(late.contains("has not landed yet"), "{late}");
        assert_eq!(
            order(&["wasp", "bee"], Until::Landed).may_start("bee", |_| Stand::Landed),
            Ok(())
        );
        assert!(
            order(&["wasp"], Until::Up)
                .may_start("fly", |_| Stand::Up)
                .unwrap_err()
                .contains("not in the order")
        );
        assert_eq!(TakeOffOrder::default().may_start("fly", |_| Stand::Below), Ok(()));
    }

    #[test]
    fn an_order_contains_known_vehicles_once() {
        let known = ["wasp", "bee"];
        assert_eq!(order(&["bee", "wasp"], Until::Up).check(&known), Ok(()));
        assert_eq!(
            order(&["fly"], Until::Up).check(&known).unwrap_err(),
            "there is no vehicle 'fly'; there are wasp, bee"
        );
        assert!(order(&["bee", "bee"], Until::Up).check(&known).unwrap_err().contains("twice"));
    }

    fn at(vehicle: usize, x_m: f64, took_off_s: f64) -> Airborne {
        Airborne { vehicle, p_world_m: DVec3::X * x_m, took_off_s }
    }

    #[test]
    fn lands_the_later_vehicle_and_below_half_the_first_too() {
        let mut watch = SeparationWatch::default();
        assert_eq!(watch.judge(1.0, &[at(0, 0.0, 5.0), at(1, 1.1, 3.0)]), []);
        let found = watch.judge(1.0, &[at(0, 0.0, 5.0), at(1, 0.9, 3.0)]);
        assert_eq!((found[0].first, found[0].later, &found[0].land), (1, 0, &vec![0]));
        assert!((found[0].apart_m - 0.9).abs() < 1e-9);
        // Reported once.
        assert_eq!(watch.judge(1.0, &[at(0, 0.0, 5.0), at(1, 0.8, 3.0)]), []);
        assert_eq!(watch.judge(1.0, &[at(0, 0.0, 5.0), at(1, 0.4, 3.0)])[0].land, [1]);
        assert_eq!(watch.judge(1.0, &[at(0, 0.0, 5.0), at(1, 0.3, 3.0)]), []);
        // Apart again, or landed: reported again.
        assert_eq!(watch.judge(1.0, &[at(0, 0.0, 5.0), at(1, 1.3, 3.0)]), []);
        assert_eq!(watch.judge(1.0, &[at(0, 0.0, 5.0), at(1, 0.9, 3.0)])[0].land, [0]);
        assert_eq!(watch.judge(1.0, &[at(1, 0.9, 3.0)]), []);
        assert_eq!(watch.judge(1.0, &[at(0, 0.0, 5.0), at(1, 0.1, 3.0)])[0].land, [0, 1]);
    }

    proptest! {
        /// Each vehicle that is too close to another is in a reported pair, and each pair lands at least one.
        #[test]
        fn no_pair_is_missed(places in prop::collection::vec((-2.0..2.0_f64, 0.0..9.0_f64), 0..6)) {
            let airborne: Vec<_> = places.iter().enumerate().map(|(n, (x_m, s))| at(n, *x_m, *s)).collect();
            let found = SeparationWatch::default().judge(1.0, &airborne);
            let close = |a: &Airborne, b: &Airborne| a.vehicle < b.vehicle && apart_m(a, b) < 1.0;
            let pairs = airborne.iter().flat_map(|a| airborne.iter().map(move |b| (a, b)));
            prop_assert_eq!(found.len(), pairs.filter(|(a, b)| close(a, b)).count());
            prop_assert!(found.iter().all(|pair| pair.land.contains(&pair.later)));
        }
    }
}
