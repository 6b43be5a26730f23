//! Compares an autopilot's parameters with the wanted ones.

use std::collections::BTreeMap;

use super::autopilot_fence::FenceCylinder;
use super::names::{ParamSpec, Version, param_spec};
use super::rules::RULES;
use super::tuning::is_tuned;
use crate::link::same;

/// Parameter with a wrong value.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Name in the autopilot's version.
    pub name: String,
    /// Value of the autopilot, in its unit; `None` if it does not have the parameter.
    pub has: Option<f64>,
    /// Wanted value, in its unit.
    pub right: f64,
    /// Danger of the present value.
    pub danger: Option<String>,
    /// The present value was tuned for this vehicle by AUTOTUNE, a flight or a person: it is kept.
    pub is_tuned: bool,
}

/// Returns the differences between an autopilot's values (`has`) and the `wanted` ones, the most dangerous first.
pub fn compare(
    version: Version,
    wanted: &BTreeMap<String, f64>,
    cylinder: FenceCylinder,
    has: impl Fn(&str) -> Option<f64>,
) -> Vec<Difference> {
    let mut found: Vec<(usize, Difference)> = Vec::new();
    for (name, &right) in wanted {
        let right = cylinder.fit(version, name, right);
        let value = has(name);
        if value.is_some_and(|value| same(value, right)) {
            continue;
        }
        let spec = param_spec(version, name);
        let is_tuned = spec
            .zip(value)
            .is_some_and(|(spec, value)| is_tuned(spec.name, spec.newest(version, value)));
        let (rank, danger) = match (spec, value) {
            (Some(spec), Some(value)) if !is_tuned => danger(version, spec, value, right),
            _ => (usize::MAX, None),
        };
        let name = name.clone();
        found.push((rank, Difference { name, has: value, right, danger, is_tuned }));
    }
    found.sort_by_key(|(rank, _)| *rank);
    found.into_iter().map(|(_, difference)| difference).collect()
}

/// Returns the rank of a value (0 is the most dangerous) and its danger.
fn danger(version: Version, spec: &ParamSpec, value: f64, right: f64) -> (usize, Option<String>) {
    let Some(rank) = RULES.iter().position(|rule| rule.name == spec.name) else {
        return (usize::MAX, None);
    };
    let newest = spec.newest(version, value);
    let outside_room = matches!(spec.name, "FENCE_ALT_MAX" | "FENCE_RADIUS") && value > right;
    match (RULES[rank].danger)(newest) {
        Some(why) => (rank, Some(why.to_owned())),
        None if outside_room => (rank, Some("the fence ends outside the room".to_owned())),
        None => (usize::MAX - 1, None),
    }
}

#[cfg(test)]
mod tests {
    use super::super::{contradictions, parse_params, shipped};
    use super::*;

    fn wanted(version: Version) -> BTreeMap<String, f64> {
        parse_params(shipped(version)).unwrap()
    }

    /// Shipped files: no unknown name, no value out of range, no contradiction, no dangerous value, and the same
    /// airframe in every version.
    #[test]
    fn shipped_files_are_valid_consistent_and_safe() {
        let mut newest: Vec<BTreeMap<&'static str, f64>> = Vec::new();
        for version in Version::ALL {
            let mut values = BTreeMap::new();
            for (name, value) in wanted(version) {
                let spec = param_spec(version, &name)
                    .unwrap_or_else(|| panic!("{name} is not a parameter of {version:?}"));
                let value = spec.newest(version, value);
                let in_range = (spec.min..=spec.max).contains(&value);
                assert!(in_range, "{name} = {value} is not from {} to {}", spec.min, spec.max);
                assert!(!spec.whole || value.fract() == 0.0, "{name} = {value} is not an integer");
                values.insert(spec.name, value);
            }
            assert_eq!(contradictions(&values), Vec::<String>::new(), "{version:?}");
            for rule in RULES {
                let value =
                    values.get(rule.name).unwrap_or_else(|| panic!("{} is not set", rule.name));
                assert_eq!((rule.danger)(*value), None, "{} in {version:?}", rule.name);
            }
            newest.push(values);
        }
        for values in &newest[1..] {
            assert_eq!(values.keys().collect::<Vec<_>>(), newest[0].keys().collect::<Vec<_>>());
            for (name, value) in values {
                assert!(same(*value, newest[0][name]), "{name}: {value} and {}", newest[0][name]);
            }
        }
    }

    #[test]
    fn finds_contradictions() {
        let check = |pairs: &[(&'static str, f64)], expected: &str| {
            let found = contradictions(&pairs.iter().copied().collect());
            assert!(found.len() == 1 && found[0].contains(expected), "{found:?}");
        };
        check(&[("EK3_SRC1_YAW", 6.0), ("VISO_TYPE", 0.0)], "VISO_TYPE = 0");
        check(&[("BATT_LOW_VOLT", 13.0), ("BATT_CRT_VOLT", 13.2)], "above BATT_CRT_VOLT");
        check(&[("RTL_ALT_M", 15.0), ("FENCE_ALT_MAX", 3.0)], "below FENCE_ALT_MAX");
        check(&[("EK3_SRC1_POSXY", 3.0), ("GPS1_TYPE", 0.0)], "needs a GPS");
        check(&[("FENCE_ENABLE", 1.0), ("FENCE_TYPE", 2.0)], "no ceiling");
        let heights = [("FENCE_ALT_MAX", 2.5), ("FENCE_ALT_MIN", 2.0), ("FENCE_MARGIN", 0.3)];
        check(&heights, "apart");
    }

    /// Parameters of the published lab, with which the vehicle would climb into the net.
    #[test]
    fn reports_the_published_labs_dangerous_values() {
        for version in Version::ALL {
            let mut has = wanted(version);
            let mut set = |name: &str, newest: f64| {
                let spec = super::super::names::param_spec(Version::V48, name).unwrap();
                has.insert(spec.name_in(version).to_owned(), spec.value_in(version, newest));
            };
            set("GPS1_TYPE", 14.0);
            set("EK3_SRC1_POSXY", 3.0);
            set("VISO_TYPE", 0.0);
            set("FENCE_ENABLE", 0.0);
            set("BATT_MONITOR", 0.0);
            set("FS_GCS_ENABLE", 1.0);
            set("RTL_ALT_M", 15.0);
            let found = compare(version, &wanted(version), FenceCylinder::default(), |name| {
                has.get(name).copied()
            });
            assert_eq!(found.len(), 7, "{found:?}");
            let dangers = found.iter().filter(|difference| difference.danger.is_some()).count();
            assert_eq!(dangers, 6, "{found:?}");
            assert_eq!(found[0].name, "FS_GCS_ENABLE");
            assert!(found[0].danger.as_ref().unwrap().contains("into the ceiling"));
            assert_eq!(found[6].danger, None, "a GPS is not dangerous: {found:?}");
        }
    }

    /// ArduCopter's default gains are dangerous on this airframe; tuned gains are not changed.
    #[test]
    fn keeps_tuned_values() {
        for version in Version::ALL {
            let check = |newest: f64| {
                let mut has = wanted(version);
                has.insert("ATC_RAT_RLL_P".to_owned(), newest);
                let found = compare(version, &wanted(version), FenceCylinder::default(), |name| {
                    has.get(name).copied()
                });
                found
                    .into_iter()
                    .map(|f| (f.name, f.danger.is_some(), f.is_tuned))
                    .collect::<Vec<_>>()
            };
            let of = |is_danger, is_tuned| vec![("ATC_RAT_RLL_P".to_owned(), is_danger, is_tuned)];
            assert_eq!(check(0.05), Vec::<(String, bool, bool)>::new());
            assert_eq!(check(0.135), of(true, false));
            assert_eq!(check(0.11), of(false, true));
        }
    }

    #[test]
    fn arena_fence_overrides_the_file() {
        let version = Version::V48;
        let cylinder =
            FenceCylinder { ceiling_m: Some(2.5), floor_m: Some(0.2), radius_m: Some(3.0) };
        let has = wanted(version);
        let found = compare(version, &wanted(version), cylinder, |name| has.get(name).copied());
        let fence: Vec<_> = found.iter().map(|f| (f.name.as_str(), f.right)).collect();
        let right = [("FENCE_ALT_MAX", 2.5), ("FENCE_RADIUS", 3.0), ("FENCE_ALT_MIN", 0.2)];
        assert_eq!(fence, right);
        assert!(found[0].danger.as_ref().unwrap().contains("outside the room"), "{found:?}");
        let nothing = compare(version, &wanted(version), FenceCylinder::default(), |_| None);
        assert!(nothing.iter().all(|f| f.has.is_none() && f.danger.is_none()));
    }
}
