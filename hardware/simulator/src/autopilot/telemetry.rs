//! Messages that the autopilot sends in streams and on request; [`streams`](super::streams) has the rates.

use glam::DVec3;
use vizflyt_protocol::geometry::yaw_of;
use vizflyt_protocol::mavlink::{
    CopterMode, attitude_to_mavlink, dialect, frd_from_body, local_position_to_mavlink,
    ned_from_world, ned_rotation_from_world, yaw_ned_from_world,
};
use vizflyt_protocol::time::AutopilotTime;

use super::dialect::{
    EkfStatusFlags, MavAutopilot, MavLandedState, MavMessage, MavModeFlag, MavProtocolCapability,
    MavState, MavSysStatusSensor, MavType, MavVtolState,
};
use super::streams::{
    ATTITUDE, ATTITUDE_QUATERNION, AUTOPILOT_VERSION, BATTERY_STATUS, EKF_STATUS_REPORT,
    EXTENDED_SYS_STATE, FENCE_STATUS, GLOBAL_POSITION_INT, GPS_GLOBAL_ORIGIN, HEARTBEAT,
    HOME_POSITION, LOCAL_POSITION_NED, RAW_IMU, SCALED_IMU, SYS_STATUS, SYSTEM_TIME, VFR_HUD,
    VIBRATION,
};
use super::{Autopilot, Guided};
use crate::airframe::GRAVITY_MPS2;

impl Autopilot {
    /// Returns a message by its id; `None` if it is unknown, or if its value is unknown.
    pub(super) fn message(&self, now: AutopilotTime, id: u32) -> Option<MavMessage> {
        let boot_ms = (now.as_ns() / 1_000_000) as u32;
        let estimate = self.estimator.estimate();
        Some(match id {
            HEARTBEAT => self.heartbeat(),
            SYS_STATUS => self.sys_status(now),
            SYSTEM_TIME => MavMessage::SYSTEM_TIME(dialect::SYSTEM_TIME_DATA {
                // The simulated board lacks a battery-backed clock.
                time_unix_usec: 0,
                time_boot_ms: boot_ms,
            }),
            SCALED_IMU => {
                let (a, g) = self.imu_numbers();
                MavMessage::SCALED_IMU(dialect::SCALED_IMU_DATA {
                    time_boot_ms: boot_ms,
                    xacc: a[0],
                    yacc: a[1],
                    zacc: a[2],
                    xgyro: g[0],
                    ygyro: g[1],
                    zgyro: g[2],
                    ..Default::default()
                })
            }
            RAW_IMU => {
                let (a, g) = self.imu_numbers();
                MavMessage::RAW_IMU(dialect::RAW_IMU_DATA {
                    time_usec: now.as_ns() / 1000,
                    xacc: a[0],
                    yacc: a[1],
                    zacc: a[2],
                    xgyro: g[0],
                    ygyro: g[1],
                    zgyro: g[2],
                    ..Default::default()
                })
            }
            ATTITUDE => MavMessage::ATTITUDE(attitude_to_mavlink(
                estimate.world_from_body,
                estimate.omega_body_radps,
                boot_ms,
            )),
            ATTITUDE_QUATERNION => {
                let q = ned_rotation_from_world(estimate.world_from_body);
                let rates = frd_from_body(estimate.omega_body_radps);
                MavMessage::ATTITUDE_QUATERNION(dialect::ATTITUDE_QUATERNION_DATA {
                    time_boot_ms: boot_ms,
                    q1: q.w as f32,
                    q2: q.x as f32,
                    q3: q.y as f32,
                    q4: q.z as f32,
                    rollspeed: rates.x as f32,
                    pitchspeed: rates.y as f32,
                    yawspeed: rates.z as f32,
                    ..Default::default()
                })
            }
            LOCAL_POSITION_NED => {
                // Not sent without a valid position.
                if !self.estimator.health(now).position {
                    return None;
                }
                MavMessage::LOCAL_POSITION_NED(local_position_to_mavlink(
                    estimate.p_world_m,
                    estimate.v_world_mps,
                    boot_ms,
                ))
            }
            GPS_GLOBAL_ORIGIN => {
                let (latitude, longitude, altitude) = self.origin?;
                MavMessage::GPS_GLOBAL_ORIGIN(dialect::GPS_GLOBAL_ORIGIN_DATA {
                    latitude,
                    longitude,
                    altitude,
                    time_usec: now.as_ns() / 1000,
                })
            }
            VFR_HUD => MavMessage::VFR_HUD(dialect::VFR_HUD_DATA {
                airspeed: 0.0,
                groundspeed: estimate.v_world_mps.truncate().length() as f32,
                alt: estimate.p_world_m.z as f32,
                climb: estimate.v_world_mps.z as f32,
                heading: yaw_ned_from_world(yaw_of(estimate.world_from_body))
                    .to_degrees()
                    .rem_euclid(360.0) as i16,
                throttle: self.throttle_percent(),
            }),
            GLOBAL_POSITION_INT => self.global_position(now, boot_ms)?,
            FENCE_STATUS => self.fence_status(),
            VIBRATION => self.vibration.message(now),
            BATTERY_STATUS => self.battery_status()?,
            AUTOPILOT_VERSION => autopilot_version(),
            EKF_STATUS_REPORT => self.ekf_status(now),
            HOME_POSITION => self.home_position(now)?,
            EXTENDED_SYS_STATE => {
                MavMessage::EXTENDED_SYS_STATE(dialect::EXTENDED_SYS_STATE_DATA {
                    vtol_state: MavVtolState::MAV_VTOL_STATE_UNDEFINED,
                    landed_state: self.landed_state(),
                })
            }
            _ => return None,
        })
    }

    fn heartbeat(&self) -> MavMessage {
        let mut base_mode = MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            | MavModeFlag::MAV_MODE_FLAG_STABILIZE_ENABLED;
        base_mode |= match self.mode {
            CopterMode::Guided | CopterMode::Loiter | CopterMode::Rtl | CopterMode::Brake => {
                MavModeFlag::MAV_MODE_FLAG_GUIDED_ENABLED
            }
            CopterMode::Stabilize | CopterMode::AltHold | CopterMode::Land => {
                MavModeFlag::MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
            }
        };
        if self.armed {
            base_mode |= MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED;
        }
        let acted = self.failsafe.gcs || self.failsafe.radio || self.failsafe.battery.is_some();
        let system_status = if self.failsafe.ekf || acted && self.armed {
            MavState::MAV_STATE_CRITICAL
        } else if self.armed && !self.landed {
            MavState::MAV_STATE_ACTIVE
        } else {
            MavState::MAV_STATE_STANDBY
        };
        MavMessage::HEARTBEAT(dialect::HEARTBEAT_DATA {
            custom_mode: self.mode as u32,
            mavtype: MavType::MAV_TYPE_QUADROTOR,
            autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            base_mode,
            system_status,
            mavlink_version: 3,
        })
    }

    fn sys_status(&self, now: AutopilotTime) -> MavMessage {
        let present = MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_3D_GYRO
            | MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_3D_ACCEL
            | MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
            | MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_VISION_POSITION
            | MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
            | MavSysStatusSensor::MAV_SYS_STATUS_AHRS
            | MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_BATTERY
            | MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK;
        let estimator = self.estimator.health(now);
        let mut health = present;
        health.set(MavSysStatusSensor::MAV_SYS_STATUS_AHRS, estimator.attitude);
        health.set(MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_VISION_POSITION, estimator.vision);
        let ready = self.armed || self.arming_refusal(now).is_none();
        health.set(MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK, ready);
        MavMessage::SYS_STATUS(dialect::SYS_STATUS_DATA {
            onboard_control_sensors_present: present,
            onboard_control_sensors_enabled: present,
            onboard_control_sensors_health: health,
            load: 100,
            voltage_battery: if self.has_gauge() {
                (self.sample.battery_v * 1000.0) as u16
            } else {
                0
            },
            current_battery: if self.has_gauge() {
                (self.sample.battery_a * 100.0) as i16
            } else {
                -1
            },
            battery_remaining: self.battery_percent(),
            ..Default::default()
        })
    }

    fn battery_status(&self) -> Option<MavMessage> {
        if !self.has_gauge() {
            return None;
        }
        // Cells that do not exist are 65535.
        let mut voltages = [u16::MAX; 10];
        voltages[0] = (self.sample.battery_v * 1000.0) as u16;
        Some(MavMessage::BATTERY_STATUS(dialect::BATTERY_STATUS_DATA {
            current_consumed: self.gauge.used_mah as i32,
            energy_consumed: -1,
            temperature: i16::MAX,
            voltages,
            current_battery: (self.sample.battery_a * 100.0) as i16,
            battery_remaining: self.battery_percent(),
            ..Default::default()
        }))
    }

    /// Returns GLOBAL_POSITION_INT on a sphere around the origin, accurate enough for a room.
    fn global_position(&self, now: AutopilotTime, boot_ms: u32) -> Option<MavMessage> {
        const EARTH_RADIUS_M: f64 = 6_378_137.0;
        let (latitude, longitude, altitude_mm) = self.origin?;
        if !self.estimator.health(now).position {
            return None;
        }
        let estimate = self.estimator.estimate();
        let (p, v) = (ned_from_world(estimate.p_world_m), ned_from_world(estimate.v_world_mps));
        let home_z = self.home.map_or(0.0, |home| home.z);
        let shrink = (f64::from(latitude) * 1e-7).to_radians().cos().max(1e-3);
        let e7 = |m: f64| ((m / EARTH_RADIUS_M).to_degrees() * 1e7) as i32;
        let cm = |mps: f64| (mps * 100.0) as i16;
        let yaw = yaw_ned_from_world(yaw_of(estimate.world_from_body));
        Some(MavMessage::GLOBAL_POSITION_INT(dialect::GLOBAL_POSITION_INT_DATA {
            time_boot_ms: boot_ms,
            lat: latitude.saturating_add(e7(p.x)),
            lon: longitude.saturating_add(e7(p.y / shrink)),
            alt: altitude_mm.saturating_add((-p.z * 1000.0) as i32),
            relative_alt: ((estimate.p_world_m.z - home_z) * 1000.0) as i32,
            vx: cm(v.x),
            vy: cm(v.y),
            vz: cm(v.z),
            hdg: (yaw.to_degrees().rem_euclid(360.0) * 100.0) as u16,
        }))
    }

    fn ekf_status(&self, now: AutopilotTime) -> MavMessage {
        let health = self.estimator.health(now);
        let mut flags = EkfStatusFlags::empty();
        flags.set(EkfStatusFlags::EKF_ATTITUDE, health.attitude);
        flags.set(EkfStatusFlags::EKF_UNINITIALIZED, !health.attitude);
        let known = EkfStatusFlags::EKF_VELOCITY_HORIZ
            | EkfStatusFlags::EKF_VELOCITY_VERT
            | EkfStatusFlags::EKF_POS_HORIZ_REL
            | EkfStatusFlags::EKF_POS_HORIZ_ABS
            | EkfStatusFlags::EKF_POS_VERT_ABS
            | EkfStatusFlags::EKF_PRED_POS_HORIZ_REL
            | EkfStatusFlags::EKF_PRED_POS_HORIZ_ABS;
        flags.set(known, health.position);
        flags.set(EkfStatusFlags::EKF_CONST_POS_MODE, health.attitude && !health.position);
        let (p, v, yaw) = self.estimator.sigmas();
        MavMessage::EKF_STATUS_REPORT(dialect::EKF_STATUS_REPORT_DATA {
            velocity_variance: v as f32,
            pos_horiz_variance: p as f32,
            pos_vert_variance: p as f32,
            compass_variance: yaw as f32,
            terrain_alt_variance: 0.0,
            flags,
            airspeed_variance: 0.0,
        })
    }

    /// Returns accelerations [mg, FRD] and rates [mrad/s, FRD].
    fn imu_numbers(&self) -> ([i16; 3], [i16; 3]) {
        let whole = |v: DVec3| v.to_array().map(|x| x as i16);
        (
            whole(frd_from_body(self.sample.accel_body_mps2) * (1000.0 / GRAVITY_MPS2)),
            whole(frd_from_body(self.sample.gyro_body_radps) * 1000.0),
        )
    }

    fn home_position(&self, now: AutopilotTime) -> Option<MavMessage> {
        let (latitude, longitude, altitude) = self.origin?;
        let p = ned_from_world(self.home?);
        Some(MavMessage::HOME_POSITION(dialect::HOME_POSITION_DATA {
            latitude,
            longitude,
            altitude,
            x: p.x as f32,
            y: p.y as f32,
            z: p.z as f32,
            q: [1.0, 0.0, 0.0, 0.0],
            time_usec: now.as_ns() / 1000,
            ..Default::default()
        }))
    }

    fn landed_state(&self) -> MavLandedState {
        if self.landed {
            MavLandedState::MAV_LANDED_STATE_ON_GROUND
        } else if matches!(self.guided, Guided::TakeOff { .. }) {
            MavLandedState::MAV_LANDED_STATE_TAKEOFF
        } else if self.mode == CopterMode::Land {
            MavLandedState::MAV_LANDED_STATE_LANDING
        } else {
            MavLandedState::MAV_LANDED_STATE_IN_AIR
        }
    }
}

/// Returns AUTOPILOT_VERSION: the simulated ArduCopter 4.8.
pub(super) fn autopilot_version() -> MavMessage {
    MavMessage::AUTOPILOT_VERSION(dialect::AUTOPILOT_VERSION_DATA {
        capabilities: MavProtocolCapability::MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
            | MavProtocolCapability::MAV_PROTOCOL_CAPABILITY_COMMAND_INT
            | MavProtocolCapability::MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
            | MavProtocolCapability::MAV_PROTOCOL_CAPABILITY_MAVLINK2,
        // ArduCopter 4.8.0, development version.
        flight_sw_version: 4 << 24 | 8 << 16,
        ..Default::default()
    })
}
