//! Compares two replies: field and amount of the largest difference.

use serde::Serialize;
use serde_json::Value;
use vizflyt_protocol::messages::{FromPlugin, Setpoint};
use vizflyt_protocol::packet::framing::{MAX_FRAMED, encode_body};
use vizflyt_protocol::time::HostTime;

/// Largest difference between two setpoints.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Path of the field, for example `velocity.v_mps.1`; empty between different kinds.
    pub field: String,
    /// Difference in the field's unit; infinite between different kinds.
    pub amount: f64,
}

/// Returns the largest difference between two replies; `None` if they are equal bit by bit.
pub fn difference(recorded: Option<&Setpoint>, replayed: Option<&Setpoint>) -> Option<Difference> {
    if bits(recorded) == bits(replayed) {
        return None;
    }
    let (a, b) = (serde_json::to_value(recorded), serde_json::to_value(replayed));
    let mut largest = Difference { field: String::new(), amount: 0.0 };
    let is_same_kind = match (a, b) {
        (Ok(a), Ok(b)) => walk(&a, &b, &mut String::new(), &mut largest),
        _ => false,
    };
    if is_same_kind {
        Some(largest)
    } else {
        Some(Difference { field: String::new(), amount: f64::INFINITY })
    }
}

/// Returns the encoded bytes of a reply, for which NaN equals itself.
fn bits(setpoint: Option<&Setpoint>) -> Vec<u8> {
    let zero = HostTime::ZERO;
    let answer =
        FromPlugin::Reply { seq: 0, entered: zero, returned: zero, setpoint: setpoint.cloned() };
    encode_body(&answer, &mut [0; MAX_FRAMED]).to_vec()
}

/// Finds the largest difference between numbers; returns `false` if the structures differ.
fn walk(a: &Value, b: &Value, path: &mut String, largest: &mut Difference) -> bool {
    let len = path.len();
    let mut inside = |key: &str, a: &Value, b: &Value| {
        if len > 0 {
            path.push('.');
        }
        path.push_str(key);
        let is_same = walk(a, b, path, largest);
        path.truncate(len);
        is_same
    };
    match (a, b) {
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len()
                && a.iter()
                    .all(|(key, value)| b.get(key).is_some_and(|other| inside(key, value, other)))
        }
        (Value::Array(a), Value::Array(b)) => {
            a.len() == b.len()
                && a.iter().zip(b).enumerate().all(|(at, (a, b))| inside(&at.to_string(), a, b))
        }
        (Value::Number(a), Value::Number(b)) => {
            let (a, b) = (a.as_f64().unwrap_or(0.0), b.as_f64().unwrap_or(0.0));
            let amount = (a - b).abs();
            // 0.0 and -0.0 have different bits, but their difference is 0.
            let is_first = largest.field.is_empty() && a.to_bits() != b.to_bits();
            if amount > largest.amount || is_first {
                *largest = Difference { field: path.clone(), amount };
            }
            true
        }
        (a, b) => a == b,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::messages::YawTarget;
    use vizflyt_sdk::glam::DVec3;

    #[allow(clippy::needless_pass_by_value)] // Why: makes the cases easier to read.
    fn check(a: Option<Setpoint>, b: Option<Setpoint>, expected: Option<(&str, f64)>) {
        let found = difference(a.as_ref(), b.as_ref());
        let found = found.as_ref().map(|found| (&*found.field, found.amount));
        assert_eq!(found, expected, "{a:?} {b:?}");
    }

    #[test]
    fn names_the_largest_difference() {
        let velocity = |x, y| Some(Setpoint::velocity(DVec3::new(x, y, 0.0), YawTarget::Keep));
        check(velocity(1.0, 2.0), velocity(1.0, 2.0), None);
        check(velocity(1.0, 2.0), velocity(1.5, 4.0), Some(("velocity.v_mps.1", 2.0)));
        check(velocity(0.0, 2.0), velocity(-0.0, 2.0), Some(("velocity.v_mps.0", 0.0)));
        check(velocity(1.0, 2.0), Some(Setpoint::Hold), Some(("", f64::INFINITY)));
        check(velocity(1.0, 2.0), None, Some(("", f64::INFINITY)));
        check(None, None, None);
        let turned = |rad| Some(Setpoint::velocity(DVec3::ZERO, YawTarget::Angle(rad)));
        check(turned(1.0), turned(0.75), Some(("velocity.yaw.angle", 0.25)));
        check(turned(1.0), velocity(0.0, 0.0), Some(("", f64::INFINITY)));
    }

    #[test]
    fn nan_equals_itself() {
        let nan = || Some(Setpoint::velocity(DVec3::NAN, YawTarget::Keep));
        check(nan(), nan(), None);
        check(
            nan(),
            Some(Setpoint::velocity(DVec3::ZERO, YawTarget::Keep)),
            Some(("", f64::INFINITY)),
        );
    }
}
