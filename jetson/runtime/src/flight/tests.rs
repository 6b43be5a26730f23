//! Tests of the flight on a virtual clock, with a vehicle that follows every command.

use glam::{DQuat, DVec3};
use vizflyt_protocol::flight_end::{Boundary, Collision, FenceBreach, Obstacle, PluginFault};
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::mavlink::{CopterMode, GuidedMotion};
use vizflyt_protocol::messages::{
    Event, Limits, OutcomeKind, PoseAges, Setpoint, YawTarget, bounded,
};
use vizflyt_protocol::time::ServerTime;

use super::*;
use crate::link::LinkEvent;
use FlightPhase::{Flying, Holding, Landed, Landing, Preparing, TakingOff};

/// Limits of the vehicle: slower than the arena, otherwise less strict.
const OWN: Limits = Limits::new(0.1, 50.0);

/// Reply of the plugin to an image.
#[derive(Clone)]
#[allow(clippy::large_enum_variant)] // Why: there is one.
enum Replies {
    Never,
    Without,
    With(Setpoint),
}

struct Script {
    flight: Flight,
    now: HostTime,
    link: LinkView,
    p_m: DVec3,
    v_mps: DVec3,
    /// Velocity of a hand that moves the vehicle. [m/s]
    hand_mps: DVec3,
    poses: bool,
    /// Whether images are published and answered with `replies`.
    images: bool,
    replies: Replies,
    /// Whether the next image is published before the tick and has no reply yet.
    next_is_shown: bool,
    /// Age of the images on arrival. [s]
    image_age_s: f64,
    seq: u64,
    orders: Orders,
    notices: Vec<FlightNotice>,
}

pub(crate) fn arena() -> ArenaInfo {
    let net = Volume::aabb(DVec3::new(-5.0, -5.0, -0.5), DVec3::new(5.0, 5.0, 4.0));
    ArenaInfo {
        time_limit_s: 30.0,
        pose_ages: PoseAges { hold_after_s: 0.5, land_after_s: 2.0 },
        ..ArenaInfo::new("test", net, Limits::new(3.0, 5.0))
    }
}

impl Script {
    fn new() -> Self {
        let now = HostTime::from_ns(1_000_000_000);
        let settings = FlightSettings {
            ready_within_s: 20.0,
            time_limit_s: 0.0,
            limits: OWN,
            slip_seed: 7,
            cameras: Vec::new(),
        };
        Self {
            flight: Flight::new(settings, now),
            now,
            link: LinkView {
                connected: true,
                armed: false,
                mode: 0,
                taken: None,
                took_off: false,
                ready_to_arm: Ok(()),
                response: Some(Response::smooth(0.2, 80.0)),
            },
            p_m: DVec3::Z * 0.05,
            v_mps: DVec3::ZERO,
            hand_mps: DVec3::ZERO,
            poses: true,
            images: true,
            replies: Replies::With(Setpoint::velocity(DVec3::X * 0.2, YawTarget::Keep)),
            next_is_shown: false,
            image_age_s: 0.03,
            seq: 0,
            orders: Orders { goal: Goal::Prepare, setpoint: None, replies_to: None },
            notices: Vec::new(),
        }
    }

    /// Returns a script that is ready and waits for start.
    fn waiting() -> Self {
        let mut script = Self::new();
        script.flight.wait_for_start();
        script.flight.handle_arena(script.now, Box::new(arena()));
        script.flight.plugin_ready();
        script.run(4.0);
        assert_eq!(script.flight.phase(), FlightPhase::Waiting, "{:?}", script.notices);
        script
    }

    fn flying() -> Self {
        let mut script = Self::new();
        script.flight.handle_arena(script.now, Box::new(arena()));
        script.flight.plugin_ready();
        script.run(4.0);
        assert_eq!(script.flight.phase(), FlightPhase::Flying, "{:?}", script.notices);
        script
    }

    fn run(&mut self, seconds: f64) {
        for _ in 0..(seconds * 50.0).round() as usize {
            self.now = self.now.plus_ns(20_000_000);
            if self.poses {
                let vehicle = VehicleMotion {
                    stamp: self.now.plus_ns(-10_000_000),
                    p_world_m: self.p_m,
                    v_world_mps: self.v_mps + self.hand_mps,
                    rotation: DQuat::IDENTITY,
                    sigma_m: 0.0,
                    allowance_s: 0.0,
                };
                self.flight.handle_pose(vehicle);
            }
            if self.images && self.flight.arena.is_some() {
                self.seq += 1;
                let mut views = Views::default();
                views[0] = Some(self.now.plus_seconds(-self.image_age_s));
                self.flight.published(self.now, self.seq, views);
                let setpoint = match self.replies.clone() {
                    Replies::Never => None,
                    Replies::Without => Some(None),
                    Replies::With(setpoint) => Some(Some(setpoint)),
                };
                if let Some(setpoint) = setpoint {
                    self.flight.replied(self.now, self.seq, setpoint);
                }
                if self.next_is_shown {
                    self.flight.published(self.now, self.seq + 1, views);
                }
            }
            self.orders = self.flight.tick(self.now, &self.link);
            self.obey();
            while let Some(notice) = self.flight.poll_notice() {
                self.notices.push(notice);
            }
        }
    }

    /// Simulates the vehicle.
    fn obey(&mut self) {
        if !self.link.connected {
            return;
        }
        self.v_mps = DVec3::ZERO;
        match self.orders.goal {
            Goal::TakeOff(height_m) => {
                (self.link.mode, self.link.armed, self.link.took_off) = (4, true, true);
                if self.p_m.z < 0.05 + f64::from(height_m) {
                    self.v_mps = DVec3::Z * 0.5;
                }
            }
            Goal::Land if self.link.armed => {
                self.link.mode = 9;
                self.v_mps = DVec3::NEG_Z * 0.5;
                if self.p_m.z < 0.05 {
                    self.link.armed = false;
                }
            }
            Goal::Prepare | Goal::Fly | Goal::Land => {}
        }
        if let Some(setpoint) = self.orders.setpoint
            && let GuidedMotion::Velocity(v) = setpoint.motion
        {
            self.v_mps = v;
        }
        self.p_m += self.v_mps * 0.02;
    }

    /// Simulates a mode change by another party.
    fn take_over(&mut self, mode: CopterMode) {
        self.link.mode = mode as u32;
        self.link.taken = Some(mode as u32);
    }

    fn server(&mut self, kind: EventKind, text: &str) {
        let event = Event { stamp: ServerTime::ZERO, kind, text: bounded(text) };
        self.flight.handle_event(self.now, &event, self.now);
    }

    fn phases(&self) -> Vec<FlightPhase> {
        let phase = |notice: &FlightNotice| match notice.kind {
            EventKind::Phase(phase) => Some(phase),
            _ => None,
        };
        self.notices.iter().filter_map(phase).collect()
    }

    /// Runs until the end and checks the outcome.
    fn check_end(&mut self, kind: OutcomeKind, reason: &str) {
        self.run(15.0);
        let outcome = self.flight.outcome().unwrap_or_else(|| panic!("{:?}", self.notices));
        assert_eq!(outcome.outcome(), kind, "{outcome:?}");
        assert!(outcome.to_string().contains(reason), "{outcome:?}");
        assert!(!self.link.armed, "it is on the ground");
    }
}

#[test]
fn flies_from_first_contact_to_the_goal_and_lands() {
    let mut script = Script::flying();
    script.run(3.0);
    assert!(script.orders.setpoint.is_some() && script.orders.goal == Goal::Fly);
    script.server(EventKind::Finished { seconds: 5.0 }, "goal reached in 5.0 s");
    script.check_end(OutcomeKind::Finished, "finished after 5.0 s");
    let phases = script.phases();
    assert_eq!(phases[..3], [Preparing, TakingOff, Flying]);
    assert_eq!(phases[phases.len() - 2..], [Landing, Landed]);
    assert!(phases[3..phases.len() - 2].iter().all(|phase| *phase == Holding), "{phases:?}");
    assert!(script.flight.seconds(script.now) > 5.0);
}

#[test]
fn does_not_arm_before_everything_is_ready() {
    type Spoil = fn(&mut Script);
    let checks: [(Spoil, &str); 6] = [
        (|script| script.link.connected = false, "no heartbeat"),
        (|script| script.link.ready_to_arm = Err("the compass is confused".into()), "compass"),
        (|script| script.poses = false, "no pose"),
        (|script| script.images = false, "not answered an image"),
        (|script| script.replies = Replies::Never, "not answered an image"),
        (|script| script.link.armed = true, "armed already"),
    ];
    for (spoil, expected) in checks {
        let mut script = Script::new();
        spoil(&mut script);
        script.flight.handle_arena(script.now, Box::new(arena()));
        script.flight.plugin_ready();
        for _ in 0..18 {
            script.run(1.0);
            assert_eq!(script.orders.goal, Goal::Prepare, "{expected}");
        }
        let reminders: Vec<_> =
            script.notices.iter().filter(|n| n.text.contains(expected)).collect();
        assert!(reminders.len() >= 3, "{expected}: {:?}", script.notices);
        script.run(3.0);
        let outcome = script.flight.outcome().unwrap();
        assert_eq!(outcome.outcome(), OutcomeKind::Error);
        assert!(outcome.to_string().starts_with("not in the air after 20 s"), "{outcome:?}");
    }
}

#[test]
fn waits_for_the_arena_and_the_plugin() {
    let mut script = Script::new();
    script.run(6.0);
    assert!(script.notices.iter().any(|notice| notice.text.contains("no answer from the server")));
    script.flight.handle_arena(script.now, Box::new(arena()));
    script.run(6.0);
    assert!(script.notices.iter().any(|notice| notice.text.contains("on_start")));
    assert_eq!(script.flight.phase(), FlightPhase::Connecting);
}

#[test]
fn reports_the_reason_of_a_server_that_rejects_the_runtime() {
    let mut script = Script::new();
    let why = "the server refuses: another runtime flies wasp".to_owned();
    script.flight.server_down(&why);
    script.run(21.0);
    assert!(!script.notices.iter().any(|notice| notice.text.contains("no answer")));
    let end = script.flight.outcome().expect("it gives up").to_string();
    assert_eq!(end, "not in the air after 20 s: the server refuses: another runtime flies wasp");
}

#[test]
fn every_event_leads_to_its_outcome() {
    let check = |kind: EventKind, outcome| {
        let mut script = Script::flying();
        script.server(kind, "the server says so");
        let brakes = matches!(outcome, OutcomeKind::Timeout);
        script.run(0.02);
        assert!(brakes || script.orders.goal == Goal::Land, "lands at once");
        script.check_end(outcome, "");
    };
    check(EventKind::Collision(touch()), OutcomeKind::Collided);
    let breach = FenceBreach {
        p_world_m: DVec3::ONE,
        margin_m: 0.0,
        boundary: Boundary::Geofence,
        speed_mps: 1.0,
        overshoot_m: 0.1,
    };
    check(EventKind::Geofence(breach), OutcomeKind::Geofence);
    check(EventKind::TimeLimit { limit_s: 30.0 }, OutcomeKind::Timeout);
    check(EventKind::Ended(EndReason::PoseLost { age_s: 2.0 }), OutcomeKind::Error);
    check(EventKind::EmergencyStop, OutcomeKind::Landed);
}

fn touch() -> Collision {
    let (p_world_m, clearance_m, speed_mps) = (DVec3::ONE, -0.1, 1.0);
    Collision { p_world_m, clearance_m, with: Obstacle::Scene, speed_mps }
}

#[test]
fn land_button_brakes_then_lands() {
    let mut script = Script::flying();
    script.server(EventKind::Land, "land");
    script.check_end(OutcomeKind::Landed, "the land button was pressed");
}

#[test]
fn collision_after_land_lands_at_once_and_keeps_the_outcome() {
    let mut script = Script::flying();
    script.run(3.0);
    script.server(EventKind::Land, "land");
    assert_eq!(script.flight.phase(), FlightPhase::Flying, "it brakes");
    script.run(0.02);
    script.server(EventKind::Collision(touch()), "touch");
    assert_eq!(script.flight.phase(), FlightPhase::Landing);
    script.check_end(OutcomeKind::Landed, "the land button was pressed");
}

#[test]
fn the_earliest_event_decides_even_if_it_arrives_late() {
    let mut script = Script::flying();
    script.run(1.0);
    let touched_at = script.now;
    script.run(0.1);
    script.flight.plugin_failed(script.now, PluginFault::ended("exit status 3"));
    script.run(0.1);
    let kind = EventKind::Collision(touch());
    let event = Event { stamp: ServerTime::ZERO, kind, text: bounded("") };
    script.flight.handle_event(script.now, &event, touched_at);
    script.check_end(OutcomeKind::Collided, "collision with an obstacle");
    // The server receives the runtime's reason; the earlier stamp wins there too.
    let ended = script.notices.iter().filter(|n| matches!(n.kind, EventKind::Ended(_))).count();
    assert_eq!(ended, 1);
}

#[test]
fn takes_off_only_after_start_is_pressed() {
    let mut script = Script::waiting();
    // Longer than the time limit of the preparation: waiting for a person has no timeout.
    script.run(60.0);
    assert_eq!((script.flight.phase(), script.orders.goal), (FlightPhase::Waiting, Goal::Prepare));
    // Start is pressed while the vehicle is not ready: it has no effect after the vehicle is ready again.
    script.link.ready_to_arm = Err("battery low".into());
    script.run(1.0);
    assert_eq!(script.flight.phase(), Preparing);
    script.server(EventKind::Start, "start");
    script.run(1.0);
    assert!(script.notices.iter().any(|n| n.text.contains("press it again")));
    script.link.ready_to_arm = Ok(());
    script.run(5.0);
    assert_eq!(script.flight.phase(), FlightPhase::Waiting);
    script.server(EventKind::Start, "start");
    script.run(4.0);
    assert_eq!(script.flight.phase(), Flying);
}

#[test]
fn both_buttons_end_a_waiting_flight_at_once() {
    for kind in [EventKind::Land, EventKind::EmergencyStop] {
        let mut script = Script::waiting();
        script.server(kind, "over");
        assert_eq!(script.flight.outcome().unwrap().outcome(), OutcomeKind::Landed);
    }
}

#[test]
fn on_the_ground_only_the_stop_button_ends_the_flight() {
    let mut script = Script::new();
    script.server(EventKind::TimeLimit { limit_s: 30.0 }, "time");
    script.server(EventKind::Collision(touch()), "floor");
    script.run(1.0);
    assert_eq!(script.flight.phase(), FlightPhase::Connecting);
    script.server(EventKind::EmergencyStop, "stop");
    assert_eq!(script.flight.outcome().unwrap().outcome(), OutcomeKind::Landed);
}

#[test]
fn failed_plugin_lands_the_vehicle_and_reports_why() {
    let mut script = Script::flying();
    script.replies = Replies::Never;
    script.flight.plugin_failed(script.now, PluginFault::ended("killed by SIGSEGV"));
    script.check_end(OutcomeKind::PluginFailed, "killed by SIGSEGV");
    let is_failure = |notice: &&FlightNotice| {
        matches!(notice.kind, EventKind::Ended(EndReason::Plugin(_)))
            && notice.text == "killed by SIGSEGV"
    };
    assert_eq!(script.notices.iter().filter(is_failure).count(), 1);

    let mut script = Script::new();
    script.flight.plugin_failed(script.now, PluginFault::ended("exit status 1"));
    assert_eq!(script.flight.outcome().unwrap().outcome(), OutcomeKind::PluginFailed);
}

#[test]
fn a_silent_plugin_holds_then_lands() {
    let mut script = Script::flying();
    script.replies = Replies::Never;
    script.run(0.7);
    assert_eq!(script.flight.phase(), FlightPhase::Holding);
    // A plugin that resumes in time controls the vehicle again.
    script.replies = Replies::With(Setpoint::Hold);
    script.run(0.5);
    assert_eq!(script.flight.phase(), FlightPhase::Flying);
    script.replies = Replies::Never;
    script.check_end(OutcomeKind::PluginFailed, "has not answered image");
}

#[test]
fn reports_why_there_is_no_setpoint() {
    // Also while an image without a reply is in transit.
    for next_is_shown in [false, true] {
        let mut script = Script::flying();
        script.next_is_shown = next_is_shown;
        script.replies = Replies::With(Setpoint::velocity(DVec3::NAN, YawTarget::Keep));
        script.check_end(OutcomeKind::PluginFailed, "not finite");
        let mut script = Script::flying();
        script.next_is_shown = next_is_shown;
        script.replies = Replies::Without;
        script.check_end(OutcomeKind::PluginFailed, "without a setpoint");
    }

    let mut script = Script::flying();
    script.images = false;
    script.check_end(OutcomeKind::Error, "no image has come");
}

#[test]
fn takes_off_only_with_fresh_images() {
    let mut script = Script::new();
    script.image_age_s = 0.3;
    script.flight.handle_arena(script.now, Box::new(arena()));
    script.flight.plugin_ready();
    script.run(8.0);
    assert_eq!(script.flight.phase(), Preparing);
    let told = "waiting: images are 300 ms old when they come; take-off allows 250";
    assert!(script.notices.iter().any(|notice| notice.text == told), "{:?}", script.notices);
    script.image_age_s = 0.03;
    script.run(4.0);
    assert_eq!(script.flight.phase(), Flying, "fresh ones, and it takes off");
    // In flight, old images are reported.
    script.image_age_s = 0.3;
    script.run(1.0);
    let told = "the plugin's images are";
    assert!(script.notices.iter().any(|notice| notice.text.starts_with(told)));
    assert_eq!(script.flight.phase(), Flying);
    script.image_age_s = 1.0;
    script.run(1.0);
    assert_eq!(script.flight.phase(), Holding);
    script.check_end(OutcomeKind::Error, "the plugin's images were 1.0 s old");
}

#[test]
fn takes_off_only_from_the_start_box_and_at_rest() {
    let mut script = Script::new();
    let start = Volume::aabb(DVec3::splat(-0.5), DVec3::splat(0.5));
    let arena = ArenaInfo { start_box: Some(start), ..arena() };
    script.flight.handle_arena(script.now, Box::new(arena));
    script.flight.plugin_ready();
    let told = |script: &Script, text: &str| {
        script.notices.iter().any(|notice| notice.text == format!("waiting: {text}"))
    };
    script.p_m.x = 1.75;
    script.run(8.0);
    assert_eq!(script.flight.phase(), Preparing);
    let outside = "the vehicle is 1.2 m outside the start box; carry it there";
    assert!(told(&script, outside), "{:?}", script.notices);
    // In the box it does not start while a hand moves it.
    script.p_m.x = 0.0;
    script.hand_mps = DVec3::Y;
    script.run(6.0);
    assert_eq!(script.flight.phase(), Preparing);
    assert!(told(&script, "the vehicle moves, at 1.0 m/s; it must stand still"));
    script.hand_mps = DVec3::ZERO;
    script.run(4.0);
    assert_eq!(script.flight.phase(), Flying);
}

#[test]
fn reports_a_missing_camera_by_name() {
    let mut script = Script::new();
    script.flight.settings.cameras = vec!["left".into()];
    script.flight.handle_arena(script.now, Box::new(arena()));
    let reason = script.flight.outcome().unwrap().to_string();
    assert!(reason.contains("this arena has no camera left"), "{reason}");
}

#[test]
fn lost_poses_hold_then_land() {
    let mut script = Script::flying();
    script.poses = false;
    script.run(0.7);
    assert_eq!(script.flight.phase(), FlightPhase::Holding);
    script.run(1.5);
    assert_eq!(script.flight.phase(), FlightPhase::Landing);
    script.check_end(OutcomeKind::Error, "pose lost for 2.0 s");
}

#[test]
fn lands_after_a_failed_take_off() {
    let mut script = Script::new();
    script.flight.handle_arena(script.now, Box::new(arena()));
    script.flight.plugin_ready();
    script.run(1.0);
    assert_eq!(script.flight.phase(), FlightPhase::TakingOff);
    script.flight.handle_link(script.now, LinkEvent::Refused("take-off denied".into()));
    script.check_end(OutcomeKind::Error, "take-off denied");
}

#[test]
fn a_lost_link_or_a_restart_ends_the_flight() {
    for (event, expected) in [(LinkEvent::Lost, "silent"), (LinkEvent::Rebooted, "restarted")] {
        let mut script = Script::flying();
        script.flight.handle_link(script.now, event);
        script.check_end(OutcomeKind::Error, expected);
    }
    // The link stays silent: the flight still ends.
    let mut script = Script::flying();
    script.link.connected = false;
    script.flight.handle_link(script.now, LinkEvent::Lost);
    script.run(12.0);
    assert_eq!(script.flight.outcome().unwrap().outcome(), OutcomeKind::Error);
}

#[test]
fn sends_nothing_after_a_mode_change_in_any_phase() {
    let modes = [
        CopterMode::AltHold,
        CopterMode::Loiter,
        CopterMode::Brake,
        CopterMode::Stabilize,
        CopterMode::Rtl,
        CopterMode::Land,
    ];
    for phase in [TakingOff, Flying, Holding, Landing] {
        for mode in modes.into_iter().filter(|&mode| (phase, mode) != (Landing, CopterMode::Land)) {
            let mut script = Script::new();
            script.flight.handle_arena(script.now, Box::new(arena()));
            script.flight.plugin_ready();
            while script.flight.phase() != TakingOff {
                script.run(0.02);
            }
            script.run(if phase == TakingOff { 0.6 } else { 4.0 });
            match phase {
                Holding => {
                    script.replies = Replies::Never;
                    script.run(0.7);
                }
                Landing => {
                    script.server(EventKind::Land, "land");
                    script.run(1.0);
                }
                _ => {}
            }
            assert_eq!(script.flight.phase(), phase, "{mode:?}");
            script.take_over(mode);
            script.run(0.1);
            let goal = if mode == CopterMode::Land { Goal::Land } else { Goal::Prepare };
            assert_eq!(
                script.orders,
                Orders { goal, setpoint: None, replies_to: None },
                "{mode:?}"
            );
            let told = format!("switched to {mode:?}, not by this runtime");
            let is_told = |notice: &FlightNotice| {
                let is_hands_off = notice.text.contains("hands off") || mode == CopterMode::Land;
                notice.text.contains(&told) && is_hands_off
            };
            assert!(script.notices.iter().any(is_told), "{phase:?} {mode:?}: {:?}", script.notices);
            // After a return to GUIDED by another party, the runtime stays passive, without a time limit.
            if mode != CopterMode::Land {
                script.link.mode = CopterMode::Guided as u32;
                script.run(90.0);
                assert_eq!(script.orders.goal, Goal::Prepare, "{phase:?} {mode:?}");
                assert!(script.flight.outcome().is_none(), "it is not left while it is armed");
                script.link.armed = false;
                script.run(1.0);
            }
            script.run(10.0);
            assert!(script.flight.outcome().is_some(), "{phase:?} {mode:?}");
        }
    }
}

#[test]
fn sends_nothing_after_a_pilot_takes_over() {
    let mut script = Script::flying();
    script.take_over(CopterMode::Loiter);
    script.run(5.0);
    assert_eq!(script.orders, Orders { goal: Goal::Prepare, setpoint: None, replies_to: None });
    assert_eq!(script.flight.phase(), FlightPhase::Landing);
    script.link.armed = false;
    script.check_end(OutcomeKind::Error, "switched to Loiter, not by this runtime");
}

#[test]
fn an_interrupt_lands_and_ends_soon() {
    let mut script = Script::flying();
    script.flight.interrupt(script.now);
    script.run(0.02);
    assert_eq!(script.orders.goal, Goal::Land);
    script.run(1.2);
    assert_eq!(script.flight.outcome().unwrap().outcome(), OutcomeKind::Landed);
    assert!(script.link.armed, "it is still coming down, in LAND");
    assert_eq!(script.link.mode, 9);
}

#[test]
fn time_limits_start_at_take_off_and_the_shorter_applies() {
    let mut script = Script::flying();
    script.flight.settings.time_limit_s = 5.0;
    script.run(1.0);
    assert_eq!(script.flight.phase(), FlightPhase::Flying);
    script.check_end(OutcomeKind::Landed, "5 s");

    let mut script = Script::flying();
    script.flight.settings.time_limit_s = 500.0;
    script.replies = Replies::With(Setpoint::Hold);
    script.run(15.0);
    script.check_end(OutcomeKind::Timeout, "30 s");
}

#[test]
fn a_changed_arena_ends_the_flight() {
    let mut script = Script::flying();
    script.flight.handle_arena(script.now, Box::new(arena()));
    assert_eq!(script.flight.phase(), FlightPhase::Flying, "the same arena is welcome");
    let other = ArenaInfo { body_radius_m: 0.3, ..arena() };
    script.flight.handle_arena(script.now, Box::new(other));
    script.check_end(OutcomeKind::Error, "another arena");

    let mut script = Script::new();
    let broken = ArenaInfo { takeoff_height_m: f64::NAN, ..arena() };
    script.flight.handle_arena(script.now, Box::new(broken));
    assert!(script.flight.outcome().unwrap().to_string().contains("takeoff_height_m"));
}

#[test]
fn the_stricter_limit_applies() {
    // The plugin requests 0.2 m/s, the arena allows 3, the vehicle 0.1.
    let mut script = Script::flying();
    script.run(1.0);
    let Some(GuidedSetpoint { motion: GuidedMotion::Velocity(v_mps), .. }) = script.orders.setpoint
    else {
        panic!("{:?}", script.orders)
    };
    assert!((v_mps.length() - 0.1).abs() < 1e-9, "{v_mps}");
}

impl Script {
    fn restart(&mut self, why: &str) {
        self.flight.plugin_restarts(self.now, why.to_owned());
    }

    fn notice_count(&self, text: &str) -> usize {
        self.notices.iter().filter(|notice| notice.text.contains(text)).count()
    }
}

#[test]
fn holds_in_the_air_while_the_plugin_restarts() {
    let mut script = Script::flying();
    script.run(1.0);
    let replies = script.replies.clone();
    script.restart("the plugin ended with exit status 3");
    script.replies = Replies::Never;
    // Longer than the timeout of a silent plugin.
    script.run(6.0);
    assert_eq!(script.flight.phase(), Holding, "{:?}", script.notices);
    assert!(script.v_mps.length() < 1e-3, "it stands still: {}", script.v_mps);
    assert_eq!(script.notice_count("exit status 3; the plugin is started again"), 1);
    script.flight.plugin_ready();
    script.replies = replies;
    script.run(1.0);
    assert_eq!(script.flight.phase(), Flying, "{:?}", script.notices);
    assert!(script.v_mps.x > 0.05, "{}", script.v_mps);
    script.replies = Replies::With(Setpoint::Land);
    script.check_end(OutcomeKind::Landed, "the plugin asked to land");
}

#[test]
fn lands_if_the_plugin_does_not_restart() {
    for replies in [Replies::Never, Replies::Without] {
        let mut script = Script::flying();
        script.restart("the plugin was killed by SIGSEGV");
        script.replies = replies;
        script.run(9.8);
        assert_eq!(script.flight.phase(), Holding);
        script.run(0.4);
        assert_eq!(script.flight.phase(), Landing);
        script
            .check_end(OutcomeKind::PluginFailed, "within 10 s; the plugin was killed by SIGSEGV");
    }
}

#[test]
fn lands_a_vehicle_left_in_the_air_by_an_earlier_runtime() {
    let mut script = Script::new();
    (script.link.armed, script.link.mode) = (true, 4);
    script.run(0.1);
    assert_eq!((script.orders.goal, script.flight.phase()), (Goal::Land, Landing));
    assert!(script.flight.outcome().is_none(), "not before it is on the ground");
    script.check_end(OutcomeKind::Error, "GUIDED without a companion");
}

#[test]
fn does_not_arm_after_the_plugin_failed_on_the_ground() {
    let mut script = Script::new();
    script.link.ready_to_arm = Err("the compass is confused".into());
    script.flight.handle_arena(script.now, Box::new(arena()));
    script.flight.plugin_ready();
    script.run(1.0);
    assert!(script.flight.is_on_ground() && script.flight.can_wait_for_plugin());
    script.restart("no model file");
    script.link.ready_to_arm = Ok(());
    script.run(3.0);
    assert_eq!(script.orders.goal, Goal::Prepare, "does not arm without a plugin");
    script.flight.plugin_ready();
    script.run(4.0);
    assert_eq!(script.flight.phase(), Flying, "{:?}", script.notices);
    // After the end of the flight, a restart is useless.
    script.flight.plugin_failed(script.now, PluginFault::ended("it is broken"));
    assert!(!script.flight.can_wait_for_plugin());
    script.restart("no");
    script.check_end(OutcomeKind::PluginFailed, "it is broken");
}

#[test]
fn setpoint_outside_the_fence_is_reported_once_and_not_flown() {
    let mut script = Script::new();
    script.flight.settings.limits = arena().limits;
    script.flight.handle_arena(script.now, Box::new(arena()));
    script.flight.plugin_ready();
    script.run(4.0);
    let p_world_m = DVec3::new(1000.0, 0.0, 1.0);
    script.replies = Replies::With(Setpoint::Position { p_world_m, yaw: YawTarget::Keep });
    script.run(12.0);
    assert!(script.p_m.x > 3.0 && script.p_m.x < 5.0, "{}", script.p_m);
    assert_eq!(script.notice_count("asks to leave the geofence"), 1, "{:?}", script.notices);
    assert_eq!(script.flight.phase(), Flying);
}
