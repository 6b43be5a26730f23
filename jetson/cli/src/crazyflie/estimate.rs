//! Conversion of a Crazyflie's estimate, as received over its radio, to a pose packet. Does not
//! need a radio.

use serde_json::{Value, json};

/// Returns the pose packet of one log record: x, y, z \[mm\] and the packed quaternion of
/// `stateEstimateZ`.
pub(crate) fn pose_packet(object: &str, seq: u64, at_ms: u32, [x, y, z, q]: [f64; 4]) -> Value {
    json!({
        "vizflyt_pose": 1,
        "object": object,
        "seq": seq,
        "stamp_ns": u64::from(at_ms) * 1_000_000,
        "clock": "sender",
        "position_m": [x / 1e3, y / 1e3, z / 1e3],
        "rotation_xyzw": unpacked(q as u32),
    })
}

/// Returns x, y, z, w from the firmware's 32 bits (`quatcompress.h`): the index of the largest
/// component, which is positive, then for each other component its sign and 9 bits of its
/// magnitude.
///
/// Accurate to 0.002, or 0.2 degrees.
fn unpacked(mut bits: u32) -> [f64; 4] {
    let largest = (bits >> 30) as usize;
    let mut q = [0.0; 4];
    let mut squares = 0.0;
    for index in (0..4).rev().filter(|&index| index != largest) {
        let size = f64::from(bits & 0x1ff) / 511.0 * std::f64::consts::FRAC_1_SQRT_2;
        q[index] = if bits >> 9 & 1 == 1 { -size } else { size };
        squares += size * size;
        bits >>= 10;
    }
    q[largest] = (1.0_f64 - squares).max(0.0).sqrt();
    q
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The firmware's compression, from its description.
    fn packed(q: [f64; 4]) -> u32 {
        let largest = (0..4).max_by(|&a, &b| q[a].abs().total_cmp(&q[b].abs())).unwrap();
        let negate = q[largest] < 0.0;
        (0..4).filter(|&index| index != largest).fold(largest as u32, |bits, index| {
            let sign = u32::from((q[index] < 0.0) != negate);
            let size = (511.0 * q[index].abs() / std::f64::consts::FRAC_1_SQRT_2 + 0.5) as u32;
            bits << 10 | sign << 9 | size
        })
    }

    #[test]
    fn unpacks_quaternions() {
        let halves = [[0.5, -0.5, 0.5, 0.5], [0.0, 0.0, 0.0, 1.0], [-0.1, 0.7, -0.3, 0.2]];
        for q in halves {
            let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
            let q = q.map(|v| v / length);
            let back = unpacked(packed(q));
            let same: f64 = q.iter().zip(back).map(|(a, b)| a * b).sum();
            assert!(same.abs() > 1.0 - 1e-5, "{q:?} {back:?}");
        }
    }

    #[test]
    fn makes_a_pose_packet_that_the_server_parses() {
        let q = [0.0, 0.0, 0.6, 0.8];
        let record = [1500.0, -250.0, 1020.0, f64::from(packed(q))];
        let text = pose_packet("bee", 7, 1234, record).to_string();
        let mut stream = vizflyt_server::poses::drivers::json::JsonStream::new(
            &vizflyt_server::poses::settings::LocalizationConfig::new(
                vizflyt_server::poses::settings::Driver::Json,
            ),
            0,
            &["bee"],
        );
        let now = vizflyt_protocol::time::ServerTime::from_ns(5_000_000_000);
        let poses = vizflyt_server::poses::drivers::udp::PoseStream::handle_packet(
            &mut stream,
            now,
            text.as_bytes(),
        );
        let pose = poses[0].world_from_body;
        assert!((pose.translation_m - glam::DVec3::new(1.5, -0.25, 1.02)).length() < 1e-9);
        assert!(pose.rotation.angle_between(glam::DQuat::from_array(q)) < 0.005);
    }
}
