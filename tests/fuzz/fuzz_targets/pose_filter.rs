//! Pose filter, by operations: poses of several sources with any sigma, stamps in the past and in the future, an IMU,
//! silence. All outputs are finite, stamps do not decrease, rejections are counted, and there is always a next timeout.
#![no_main]
use glam::DQuat;
use libfuzzer_sys::fuzz_target;
use vizflyt_arena::pose::{ImuReading, Measured, PoseConfig, PoseFilter, PoseSigma};
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::time::ServerTime;

struct Input<'a>(&'a [u8]);

impl Input<'_> {
    fn byte(&mut self) -> Option<u8> {
        let (&first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(first)
    }

    /// Reads a number in the usual range, or any floating-point number.
    fn number(&mut self, usual: f64) -> Option<f64> {
        let kind = self.byte()?;
        if kind < 250 {
            return Some((f64::from(kind) - 125.0) / 125.0 * usual);
        }
        let (bytes, rest) = self.0.split_first_chunk::<8>()?;
        self.0 = rest;
        Some(f64::from_le_bytes(*bytes))
    }

    fn three(&mut self, usual: f64) -> Option<[f64; 3]> {
        Some([self.number(usual)?, self.number(usual)?, self.number(usual)?])
    }
}

struct Machine {
    filter: PoseFilter,
    now: ServerTime,
    refused: u64,
}

impl Machine {
    fn step(&mut self, input: &mut Input<'_>) -> Option<()> {
        let before = self.filter.newest().map(|newest| newest.stamp);
        let kind = input.byte()? % 5;
        match kind {
            0 | 1 => {
                let source = input.byte()?;
                let late_s = input.number(0.05)?;
                let turned = quaternion(input.three(3.0)?);
                let world_from_body = Pose::new(
                    input.three(3.0)?.into(),
                    if turned.is_finite() { turned.normalize() } else { turned },
                );
                self.filter.set_in_flight(source >= 128);
                let measured = Measured {
                    source,
                    arrival: self.now,
                    sigma: match source % 2 {
                        0 => None,
                        _ => Some(PoseSigma {
                            position_m: input.three(0.01)?.into(),
                            rotation_rad: input.three(0.01)?.into(),
                        }),
                    },
                    ..Measured::new(self.now.plus_seconds(-late_s), world_from_body)
                };
                self.refused += u64::from(self.filter.handle_pose(&measured).is_err());
            }
            2 => {
                let late_s = input.number(0.05)?;
                self.filter.handle_imu(&ImuReading {
                    stamp: self.now.plus_seconds(-late_s),
                    accel_mps2: input.three(20.0)?.into(),
                    gyro_radps: input.three(5.0)?.into(),
                });
            }
            3 => self.now = self.now.plus_seconds(f64::from(input.byte()?) * 1e-3),
            _ => {
                self.filter.handle_timeout(self.now);
                let _ = self.filter.poll_change();
            }
        }
        let Some(newest) = self.filter.newest().copied() else { return Some(()) };
        assert!(newest.is_valid(), "{newest:?}");
        assert!(before.is_none_or(|before| newest.stamp >= before), "{before:?} {newest:?}");
        // IMU readings are processed when a pose is requested: let several accumulate.
        if kind != 2 {
            let soon = self.filter.predict(self.now).unwrap();
            assert!(soon.is_valid(), "{soon:?}");
        }
        let quality = self.filter.quality(self.now);
        assert!(quality.position_sigma_mm.is_finite() && quality.innovation_sigmas.is_finite());
        assert_eq!(self.filter.rejected().total(), self.refused);
        if let Some(due) = self.filter.poll_timeout() {
            assert!(due > newest.stamp);
        }
        Some(())
    }
}

/// Returns a quaternion of any length, usually valid.
fn quaternion([x, y, z]: [f64; 3]) -> DQuat {
    DQuat::from_xyzw(x, y, z, 1.0)
}

fuzz_target!(|data: &[u8]| {
    let now = ServerTime::from_ns(10_000_000_000);
    let filter = PoseFilter::new(&PoseConfig::default());
    let mut machine = Machine { filter, now, refused: 0 };
    let mut input = Input(data);
    while machine.step(&mut input).is_some() {}
});
