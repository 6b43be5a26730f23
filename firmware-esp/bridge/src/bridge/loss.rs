//! What a bridge does when the companion falls silent: it asks the autopilot to land, itself.
//!
//! Whoever streams setpoints or poses, ten within two seconds, is the companion; a ground station
//! that sends one target now and then is not. While the vehicle is armed and follows a companion
//! (GUIDED, or PX4's OFFBOARD), silence of the companion for the set time means LAND: repeated
//! until the autopilot has left that mode. A companion that comes back meanwhile changes nothing:
//! a vehicle that changes its mind halfway is harder to foresee than one that lands.

use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::time::HostTime;

/// Contents of the autopilot's heartbeat.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Flight {
    pub armed: bool,
    pub mode: u32,
    /// PX4, whose modes are numbered otherwise.
    pub px4: bool,
}

impl Flight {
    /// Before the first heartbeat; as the default, but `const`.
    pub(crate) const UNKNOWN: Self = Self { armed: false, mode: 0, px4: false };

    /// Whether the vehicle obeys a companion.
    pub(crate) fn follows(self) -> bool {
        let mode = if self.px4 { PX4_OFFBOARD } else { CopterMode::Guided as u32 };
        self.armed && self.mode == mode
    }
}

/// PX4's main mode 6 in `custom_mode`.
const PX4_OFFBOARD: u32 = 6 << 16;
/// Packets that make a stream, within [`STREAM_S`].
const STREAM: u8 = 10;
const STREAM_S: f64 = 2.0;
/// A companion silent for this long has ended, if nothing follows it. Longer than the time from the
/// last pose before arming to the heartbeat that reports it. [s]
const ENDED_S: f64 = 5.0;
/// LAND is repeated this often until it is acknowledged. [s]
const REPEAT_S: f64 = 0.3;
/// And this often from then on, until the mode has changed: heartbeats come once a second. [s]
const REPEAT_ACKNOWLEDGED_S: f64 = 1.5;

/// The companion and its silence.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LinkLoss {
    streamer: Option<Streamer>,
    landing: Option<Landing>,
}

#[derive(Clone, Copy, Debug)]
struct Streamer {
    source: (u8, u8),
    received_at: HostTime,
    counted: u8,
    counting_since: HostTime,
}

#[derive(Clone, Copy, Debug)]
struct Landing {
    repeat_at: HostTime,
    confirmation: u8,
    acknowledged: bool,
}

/// What is to be done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LossAction {
    /// Send LAND with this count of repetitions; zero means it begins: announce it.
    Land {
        /// MAVLink's count of repetitions.
        confirmation: u8,
    },
}

impl LinkLoss {
    /// No companion yet; as the default, but `const`.
    pub(crate) const NONE: Self = Self { streamer: None, landing: None };

    /// Returns who streams, if anybody does.
    pub(crate) fn companion(&self) -> Option<(u8, u8)> {
        self.streamer.filter(|streamer| streamer.counted >= STREAM).map(|streamer| streamer.source)
    }

    /// Takes note of a packet from the network; `streams`: it is a setpoint or a pose.
    pub(crate) fn note_packet(&mut self, now: HostTime, source: (u8, u8), streams: bool) {
        match &mut self.streamer {
            Some(streamer) if streamer.source == source => {
                streamer.received_at = now;
                if streams && streamer.counted < STREAM {
                    if now.seconds_since(streamer.counting_since) > STREAM_S {
                        streamer.counting_since = now;
                        streamer.counted = 0;
                    }
                    streamer.counted += 1;
                }
            }
            // Another companion takes over only from a silent one, or from no companion.
            Some(streamer)
                if streamer.counted >= STREAM
                    && now.seconds_since(streamer.received_at) < STREAM_S => {}
            _ if streams => {
                self.streamer =
                    Some(Streamer { source, received_at: now, counted: 1, counting_since: now });
            }
            _ => {}
        }
    }

    /// Takes note of the autopilot's answer to LAND.
    pub(crate) fn note_acknowledged(&mut self, now: HostTime) {
        if let Some(landing) = &mut self.landing {
            landing.acknowledged = true;
            landing.repeat_at = now.plus_seconds(REPEAT_ACKNOWLEDGED_S);
        }
    }

    /// Whether it is landing the vehicle now.
    pub(crate) fn is_landing(&self) -> bool {
        self.landing.is_some()
    }

    /// Returns when [`Self::poll`] has something to do, if `flight` stays.
    pub(crate) fn due(&self, flight: Flight, loss_ms: u16) -> Option<HostTime> {
        if let Some(landing) = self.landing {
            return Some(landing.repeat_at);
        }
        let streamer = self.streamer.filter(|streamer| streamer.counted >= STREAM)?;
        (flight.follows() && loss_ms > 0)
            .then(|| streamer.received_at.plus_ns(i64::from(loss_ms) * 1_000_000))
    }

    /// Returns what is to be done at `now`.
    pub(crate) fn poll(
        &mut self,
        now: HostTime,
        flight: Flight,
        loss_ms: u16,
    ) -> Option<LossAction> {
        if self.landing.is_some() && !flight.follows() {
            self.landing = None;
            // Its stream must be seen again before it is followed.
            self.streamer = None;
        }
        // On the ground or in a pilot's mode a companion may end as it likes; whoever takes off
        // later without one is not landed for its silence.
        let ended = |streamer: &Streamer| now.seconds_since(streamer.received_at) > ENDED_S;
        if !flight.follows() && self.streamer.as_ref().is_some_and(ended) {
            self.streamer = None;
        }
        if self.due(flight, loss_ms)? > now {
            return None;
        }
        let confirmation = self.landing.map_or(0, |landing| landing.confirmation.saturating_add(1));
        let acknowledged = self.landing.is_some_and(|landing| landing.acknowledged);
        let repeat_s = if acknowledged { REPEAT_ACKNOWLEDGED_S } else { REPEAT_S };
        let repeat_at = now.plus_seconds(repeat_s);
        self.landing = Some(Landing { repeat_at, confirmation, acknowledged });
        Some(LossAction::Land { confirmation })
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::vec::Vec;

    use super::*;

    const RUNTIME: (u8, u8) = (255, 191);
    const GUIDED: Flight = Flight { armed: true, mode: 4, px4: false };

    fn at(ms: u64) -> HostTime {
        HostTime::from_ns(ms * 1_000_000)
    }

    /// Streams from 0 to 1 s, then is silent; returns when LAND was sent, to `until_ms`.
    fn landings(
        flight: impl Fn(u64) -> Flight,
        loss_ms: u16,
        period_ms: u64,
        until_ms: u64,
    ) -> Vec<(u64, u8)> {
        let mut loss = LinkLoss::default();
        let mut sent = Vec::new();
        for ms in 0..until_ms {
            if ms <= 1000 && ms % period_ms == 0 {
                loss.note_packet(at(ms), RUNTIME, true);
            }
            if let Some(LossAction::Land { confirmation }) = loss.poll(at(ms), flight(ms), loss_ms)
            {
                sent.push((ms, confirmation));
            }
        }
        sent
    }

    #[test]
    fn silence_lands_and_repeats_until_the_mode_changes() {
        let land_at = |ms| if ms < 2700 { GUIDED } else { Flight { mode: 9, ..GUIDED } };
        assert_eq!(landings(land_at, 1000, 20, 9000), [(2000, 0), (2300, 1), (2600, 2)]);
    }

    #[test]
    fn nothing_happens_where_nothing_follows() {
        for flight in [Flight { armed: false, ..GUIDED }, Flight { mode: 5, ..GUIDED }] {
            assert_eq!(landings(|_| flight, 1000, 20, 5000), []);
        }
        assert_eq!(landings(|_| GUIDED, 0, 20, 5000), []);
        // One target each 400 ms is a ground station's.
        assert_eq!(landings(|_| GUIDED, 1000, 400, 5000), []);
        let px4 = Flight { armed: true, mode: 6 << 16, px4: true };
        assert_eq!(landings(|_| px4, 1000, 20, 2200), [(2000, 0)]);
        // ArduCopter's number means nothing to PX4.
        assert_eq!(landings(|_| Flight { mode: 4, ..px4 }, 1000, 20, 5000), []);
    }

    #[test]
    fn a_companion_that_ended_on_the_ground_lands_no_vehicle_later() {
        let pilot = |ms| Flight { mode: 5, armed: ms < 3000, ..GUIDED };
        let later = |ms| if ms < 7000 { pilot(ms) } else { GUIDED };
        assert_eq!(landings(later, 1000, 20, 12_000), []);
        // One that falls silent while the vehicle is being armed does.
        let soon = |ms| if ms < 4000 { pilot(ms) } else { GUIDED };
        assert_eq!(landings(soon, 1000, 20, 4200), [(4000, 0)]);
    }

    #[test]
    fn only_packets_of_the_companion_count() {
        let mut loss = LinkLoss::default();
        for ms in (0..500).step_by(20) {
            loss.note_packet(at(ms), RUNTIME, true);
        }
        loss.note_packet(at(1200), RUNTIME, false);
        loss.note_packet(at(1900), (255, 190), true);
        assert_eq!(loss.due(GUIDED, 1000), Some(at(2200)));
    }

    #[test]
    fn an_acknowledged_landing_is_repeated_slowly() {
        let mut loss = LinkLoss::default();
        for ms in (0..=500).step_by(20) {
            loss.note_packet(at(ms), RUNTIME, true);
        }
        assert_eq!(loss.poll(at(1500), GUIDED, 1000), Some(LossAction::Land { confirmation: 0 }));
        loss.note_acknowledged(at(1510));
        assert_eq!(loss.due(GUIDED, 1000), Some(at(3010)));
        // It comes back: the landing goes on.
        loss.note_packet(at(1600), RUNTIME, true);
        assert_eq!(loss.poll(at(3010), GUIDED, 1000), Some(LossAction::Land { confirmation: 1 }));
        assert_eq!(loss.poll(at(3100), Flight { mode: 9, ..GUIDED }, 1000), None);
        assert!(!loss.is_landing());
    }
}
