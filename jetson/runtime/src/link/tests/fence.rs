//! Upload of the arena's polygons to the autopilot.

use glam::DVec2;
use vizflyt_protocol::mavlink::dialect::{
    GPS_GLOBAL_ORIGIN_DATA, MISSION_ACK_DATA, MISSION_ITEM_INT_DATA, MISSION_REQUEST_DATA,
    MISSION_REQUEST_INT_DATA, MavCmd, MavMissionResult, MavMissionType,
};
use vizflyt_protocol::mavlink::{FenceSide, GlobalPoint};

use super::refusals::param;
use super::*;

const ACCEPTED: MavMissionResult = MavMissionResult::MAV_MISSION_ACCEPTED;
const DENIED: MavMissionResult = MavMissionResult::MAV_MISSION_DENIED;

/// Returns an inclusion square of 4 m and an exclusion triangle.
fn fence() -> Vec<FencePolygon> {
    let at = |corners: &[(f64, f64)]| corners.iter().map(|&p| DVec2::from(p)).collect();
    let square = at(&[(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)]);
    let triangle = at(&[(1.0, 0.0), (1.5, 0.0), (1.0, 0.5)]);
    vec![
        FencePolygon { side: FenceSide::Inside, corners_m: square },
        FencePolygon { side: FenceSide::Outside, corners_m: triangle },
    ]
}

impl Script {
    /// Returns a script with a fence upload in progress.
    fn fenced() -> Self {
        let mut script = Self::ready();
        script.link.set_fence(script.now, fence());
        // The monitored parameters are requested first; the script does not reply to these.
        while script.offers() == 0 {
            script.run(0.1);
        }
        script
    }

    fn offers(&self) -> usize {
        self.count(|m| matches!(m, MavMessage::MISSION_COUNT(m) if m.count == 7))
    }

    fn ask(&mut self, seq: u16) -> Option<MISSION_ITEM_INT_DATA> {
        let mission_type = MavMissionType::MAV_MISSION_TYPE_FENCE;
        let (target_system, target_component) = (255, 191);
        self.inject(&if self.kind == MavAutopilot::MAV_AUTOPILOT_PX4 || seq.is_multiple_of(2) {
            MavMessage::MISSION_REQUEST_INT(MISSION_REQUEST_INT_DATA {
                seq,
                target_system,
                target_component,
                mission_type,
            })
        } else {
            MavMessage::MISSION_REQUEST(MISSION_REQUEST_DATA {
                seq,
                target_system,
                target_component,
                mission_type,
            })
        });
        match self.sent.last() {
            Some(MavMessage::MISSION_ITEM_INT(item)) if item.seq == seq => Some(item.clone()),
            _ => None,
        }
    }

    fn acknowledge(&mut self, result: MavMissionResult) {
        self.inject(&MavMessage::MISSION_ACK(MISSION_ACK_DATA {
            target_system: 255,
            target_component: 191,
            mavtype: result,
            mission_type: MavMissionType::MAV_MISSION_TYPE_FENCE,
            ..Default::default()
        }));
    }

    fn fence_events(&self) -> Vec<&FenceEvent> {
        let mut events = Vec::new();
        for event in &self.events {
            if let LinkEvent::Fence(event) = event {
                events.push(event);
            }
        }
        events
    }
}

#[test]
fn converts_corners_with_the_autopilots_origin() {
    let mut script = Script::new();
    script.link.set_fence(script.now, fence());
    script.heartbeat();
    script.run(3.0);
    assert_eq!(script.offers(), 0, "no origin yet");
    let origin = GlobalPoint { latitude_e7: 480_000_000, longitude_e7: 110_000_000 };
    script.inject(&MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA {
        latitude: origin.latitude_e7,
        longitude: origin.longitude_e7,
        ..Default::default()
    }));
    script.run(6.0);
    assert!(script.offers() > 0);
    let mut corners_m = Vec::new();
    for seq in 0..7 {
        let item = script.ask(seq).expect("the corner");
        let place = GlobalPoint { latitude_e7: item.x, longitude_e7: item.y };
        corners_m.push(place.from_origin_m(origin));
        let (command, corners) = if seq < 4 {
            (MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, 4.0)
        } else {
            (MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION, 3.0)
        };
        assert_eq!((item.command, item.param1), (command, corners));
    }
    assert!(script.ask(7).is_none() && script.ask(u16::MAX).is_none());
    for (corner_m, right_m) in corners_m.iter().zip(fence().iter().flat_map(|p| &p.corners_m)) {
        assert!((*corner_m - *right_m).length() < 0.01, "{corner_m} is not {right_m}");
    }
    assert!(script.link.is_busy_with_fence());
    script.acknowledge(ACCEPTED);
    assert_eq!(script.fence_events(), [&FenceEvent::Accepted(2)]);
    // Repeating the same polygons or the same origin changes nothing.
    let offers = script.offers();
    script.link.set_fence(script.now, fence());
    script.run(5.0);
    assert!(script.offers() == offers && !script.link.is_busy_with_fence());
}

#[test]
fn arming_waits_for_the_upload_and_an_armed_vehicle_gets_no_upload() {
    let mut script = Script::fenced();
    script.run(4.0);
    assert!(script.missing().contains("fence is being uploaded"), "{}", script.missing());
    for seq in 0..7 {
        script.ask(seq);
    }
    script.acknowledge(ACCEPTED);
    assert_eq!(script.link.ready_to_arm(script.now), Ok(()));

    script.armed = true;
    script.heartbeat();
    let offers = script.offers();
    let mut other = fence();
    other.pop();
    script.link.set_fence(script.now, other);
    script.run(3.0);
    assert_eq!(script.count(|m| matches!(m, MavMessage::MISSION_COUNT(_))), offers);
    script.armed = false;
    script.run(3.0);
    assert!(script.count(|m| matches!(m, MavMessage::MISSION_COUNT(m) if m.count == 4)) > 0);
}

/// PSC_JERK_XY and WPNAV_ACCEL are ArduCopter's names before 4.7: later versions do not answer them.
#[test]
fn upload_does_not_wait_for_names_that_the_autopilot_lacks() {
    let mut script = Script::new();
    script.link.set_fence(script.now, fence());
    script.heartbeat();
    script.inject(&MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA::default()));
    let asked = |script: &Script| {
        let name = |message: &MavMessage| match message {
            MavMessage::PARAM_REQUEST_READ(m) => m.param_id.to_str().ok().map(str::to_owned),
            _ => None,
        };
        script.sent.iter().filter_map(name).collect::<Vec<_>>()
    };
    // Each reply makes room for another request.
    let mut seen = 0;
    while let Some(name) = asked(&script).get(seen) {
        assert_eq!(script.offers(), 0, "parameters first: {name}");
        if !["PSC_JERK_XY", "WPNAV_ACCEL"].contains(&name.as_str()) {
            param(&mut script, name, 1.0);
        }
        seen += 1;
    }
    assert!(script.link.is_busy_with_params(), "two names are not given up yet");
    assert_eq!((script.link.params().len(), script.offers()), (seen - 2, 1));
}

#[test]
fn repeats_lost_offers_and_gives_up_without_replies() {
    let mut script = Script::fenced();
    script.run(3.5);
    assert_eq!(script.offers(), 3);
    // An upload that stops halfway is started again.
    script.ask(0);
    script.run(2.0);
    assert_eq!(script.offers(), 4);
    // An acknowledgement before the last corner is ignored.
    script.acknowledge(ACCEPTED);
    script.acknowledge(MavMissionResult::MAV_MISSION_INVALID_SEQUENCE);
    assert_eq!(script.fence_events(), [] as [&FenceEvent; 0]);
    script.run(10.0);
    assert_eq!(script.offers(), 5);
    let [FenceEvent::Rejected(why)] = script.fence_events()[..] else {
        panic!("{:?}", script.fence_events())
    };
    assert_eq!(why, "it does not answer");
    // The flight continues without it, because guard and referee check the fence.
    assert_eq!(script.link.ready_to_arm(script.now), Ok(()));
    let warnings: Vec<_> = script.events.iter().filter_map(LinkEvent::warning).collect();
    let expected = "own fence is not the arena's: it does not answer";
    assert!(warnings.iter().any(|warning| warning.contains(expected)), "{warnings:?}");
}

#[test]
fn reports_a_rejection_and_retries_with_a_busy_autopilot() {
    let mut script = Script::fenced();
    script.run(1.0);
    script.acknowledge(DENIED);
    let offers = script.offers();
    script.run(2.0);
    assert_eq!(script.offers(), offers + 1);
    script.acknowledge(MavMissionResult::MAV_MISSION_NO_SPACE);
    let no_room = FenceEvent::Rejected("it has no space for this many corners".into());
    assert_eq!(script.fence_events(), [&no_room]);
    script.run(5.0);
    assert_eq!(script.offers(), offers + 1);
}

#[test]
fn fence_is_uploaded_again_after_a_restart() {
    let mut script = Script::fenced();
    for seq in 0..7 {
        script.ask(seq);
    }
    script.acknowledge(ACCEPTED);
    let offers = script.offers();
    script.run_silently(3.5);
    script.heartbeat();
    script.inject(&MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA::default()));
    script.run(5.0);
    assert!(script.offers() > offers);
}

#[test]
fn px4_gets_no_fence() {
    let mut script = Script::new();
    script.kind = MavAutopilot::MAV_AUTOPILOT_PX4;
    script.link.set_fence(script.now, fence());
    script.heartbeat();
    script.run(2.0);
    assert_eq!(script.offers(), 0);
    let [FenceEvent::Rejected(why)] = script.fence_events()[..] else {
        panic!("{:?}", script.fence_events())
    };
    assert!(why.contains("no global position"), "{why}");
}
