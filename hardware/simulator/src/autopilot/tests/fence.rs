//! Fence polygons and floor: uploaded, stored, and enforced without a companion.

use glam::DVec2;
use vizflyt_protocol::mavlink::dialect::{
    FenceBreach, MISSION_CLEAR_ALL_DATA, MISSION_COUNT_DATA, MISSION_REQUEST_INT_DATA,
    MISSION_REQUEST_LIST_DATA, MavMissionResult, MavMissionType,
};
use vizflyt_protocol::mavlink::{FenceCorner, FenceSide, GlobalPoint, fence_corner_to_mavlink};

use super::*;

const FENCE: MavMissionType = MavMissionType::MAV_MISSION_TYPE_FENCE;
/// Origin that [`Companion::set_origin`] sets.
const ORIGIN: GlobalPoint = GlobalPoint { latitude_e7: 423_000_000, longitude_e7: -718_000_000 };

const ROOM: [(f64, f64); 4] = [(-3.0, -2.0), (4.0, -2.0), (4.0, 2.0), (-3.0, 2.0)];
const BOX: [(f64, f64); 4] = [(1.5, -0.5), (2.5, -0.5), (2.5, 0.5), (1.5, 0.5)];

fn corners(side: FenceSide, corners_m: &[(f64, f64)]) -> Vec<FenceCorner> {
    let corner = |&(x, y): &(f64, f64)| FenceCorner {
        side,
        corners: corners_m.len() as u16,
        place: ORIGIN.offset(DVec2::new(x, y)),
    };
    corners_m.iter().map(corner).collect()
}

fn room_with_a_box() -> Vec<FenceCorner> {
    [corners(FenceSide::Inside, &ROOM), corners(FenceSide::Outside, &BOX)].concat()
}

/// A vehicle with polygons and floor enabled, and LAND as fence action.
fn config(kind: f32) -> SimulationConfig {
    let params = [
        ("FENCE_ENABLE", 1.0),
        ("FENCE_TYPE", kind),
        ("FENCE_ACTION", 2.0),
        ("FENCE_ALT_MIN", 0.3),
        ("FENCE_MARGIN", 0.3),
    ];
    let params = params.map(|(name, value)| (name.to_owned(), value)).to_vec();
    SimulationConfig { params, ..Default::default() }
}

impl Companion {
    fn announce(&mut self, count: u16) {
        self.send(&MavMessage::MISSION_COUNT(MISSION_COUNT_DATA {
            count,
            target_system: 1,
            target_component: 1,
            mission_type: FENCE,
            ..Default::default()
        }));
        self.tick();
    }

    fn item(&mut self, seq: u16, corner: &FenceCorner) {
        let item = fence_corner_to_mavlink(corner, seq, (1, 1));
        self.send(&MavMessage::MISSION_ITEM_INT(item));
        self.tick();
    }

    fn asked_for(&self) -> Option<u16> {
        match self.newest.get(&40) {
            Some(MavMessage::MISSION_REQUEST(m)) if m.mission_type == FENCE => Some(m.seq),
            _ => None,
        }
    }

    fn answered(&self) -> Option<MavMissionResult> {
        match self.newest.get(&47) {
            Some(MavMessage::MISSION_ACK(m)) => Some(m.mavtype),
            _ => None,
        }
    }

    fn upload(&mut self, fence: &[FenceCorner]) {
        self.newest.remove(&47);
        self.announce(fence.len() as u16);
        for (seq, corner) in (0..).zip(fence) {
            assert_eq!(self.asked_for(), Some(seq));
            self.item(seq, corner);
        }
    }

    /// Downloads the complete fence.
    fn download(&mut self) -> Vec<(i32, i32)> {
        let (target_system, target_component, mission_type) = (1, 1, FENCE);
        self.send(&MavMessage::MISSION_REQUEST_LIST(MISSION_REQUEST_LIST_DATA {
            target_system,
            target_component,
            mission_type,
        }));
        self.tick();
        let Some(MavMessage::MISSION_COUNT(m)) = self.newest.get(&44) else { panic!("no count") };
        (0..m.count)
            .map(|seq| {
                self.send(&MavMessage::MISSION_REQUEST_INT(MISSION_REQUEST_INT_DATA {
                    seq,
                    target_system,
                    target_component,
                    mission_type,
                }));
                self.tick();
                match self.newest.get(&73) {
                    Some(MavMessage::MISSION_ITEM_INT(m)) if m.seq == seq => (m.x, m.y),
                    other => panic!("no item {seq}: {other:?}"),
                }
            })
            .collect()
    }

    fn takes_off(&mut self) {
        assert_eq!(self.set_mode(CopterMode::Guided), ACCEPTED);
        assert_eq!(self.arm(), ACCEPTED, "{:?}", self.texts);
        assert_eq!(self.take_off(1.2), ACCEPTED);
        self.until(10.0, "the height", |c| c.p().z > 1.1);
    }
}

#[test]
fn a_no_fly_box_lands_the_vehicle_at_its_edge() {
    let mut c = Companion::new(config(4.0));
    c.prepare();
    c.upload(&room_with_a_box());
    assert_eq!(c.answered(), Some(MavMissionResult::MAV_MISSION_ACCEPTED));
    c.takes_off();
    // A position inside the box is rejected; a velocity is flown until the edge.
    c.set_once(GuidedMotion::Position(DVec3::new(2.0, 0.0, 1.2)), YawTarget::Angle(0.0));
    c.wait(4.0);
    assert!(c.p().truncate().length() < 0.2, "{:?}", c.p());
    c.fly(GuidedMotion::Velocity(DVec3::X * 0.5), YawTarget::Angle(0.0));
    c.until(10.0, "LAND", |c| c.mode() == CopterMode::Land);
    assert!((c.p().x - 1.5).abs() < 0.15, "{:?}", c.p());
    assert!(c.texts_contain("Polygon fence breached"), "{:?}", c.texts);
    c.wait(1.1);
    let Some(MavMessage::FENCE_STATUS(m)) = c.newest.get(&162) else { panic!() };
    assert_eq!((m.breach_count, m.breach_type), (1, FenceBreach::FENCE_BREACH_BOUNDARY));
    c.until(15.0, "the disarm", |c| !c.armed());
    assert!(c.p().x < 2.0, "{:?}", c.p());
    // The vehicle stands in the box, so arming is refused.
    assert_eq!(c.set_mode(CopterMode::Guided), ACCEPTED);
    assert_eq!(c.arm(), FAILED);
}

#[test]
fn the_inclusion_polygon_lands_the_vehicle_at_its_edge() {
    let mut c = Companion::new(config(4.0));
    c.prepare();
    c.upload(&room_with_a_box());
    c.takes_off();
    c.fly(GuidedMotion::Velocity(DVec3::Y * 0.5), YawTarget::Angle(0.0));
    c.until(10.0, "LAND", |c| c.mode() == CopterMode::Land);
    assert!((c.p().y - 2.0).abs() < 0.15, "{:?}", c.p());
}

#[test]
fn the_fence_survives_a_reboot_and_can_be_downloaded() {
    let mut c = Companion::new(config(4.0));
    c.prepare();
    c.upload(&room_with_a_box());
    let places: Vec<_> = room_with_a_box()
        .iter()
        .map(|corner| (corner.place.latitude_e7, corner.place.longitude_e7))
        .collect();
    assert_eq!(c.download(), places);
    c.lab.reboot();
    c.wait(4.0);
    assert_eq!(c.download(), places);
    let (target_system, target_component, mission_type) = (1, 1, FENCE);
    c.send(&MavMessage::MISSION_CLEAR_ALL(MISSION_CLEAR_ALL_DATA {
        target_system,
        target_component,
        mission_type,
    }));
    c.tick();
    assert_eq!(c.download(), []);
}

#[test]
fn an_incomplete_upload_changes_nothing() {
    let mut c = Companion::new(config(4.0));
    c.prepare();
    c.upload(&room_with_a_box());
    let kept = c.download();

    // A polygon that lacks a corner.
    c.upload(&room_with_a_box()[..7]);
    assert_eq!(c.answered(), Some(MavMissionResult::MAV_MISSION_ERROR));
    // An item in another frame ends the upload.
    c.announce(4);
    let mut item = fence_corner_to_mavlink(&room_with_a_box()[0], 0, (1, 1));
    item.frame = vizflyt_protocol::mavlink::dialect::MavFrame::MAV_FRAME_LOCAL_NED;
    c.send(&MavMessage::MISSION_ITEM_INT(item));
    c.tick();
    assert_eq!(c.answered(), Some(MavMissionResult::MAV_MISSION_UNSUPPORTED_FRAME));
    // Too many items.
    c.announce(1000);
    assert_eq!(c.answered(), Some(MavMissionResult::MAV_MISSION_NO_SPACE));
    // A duplicate item is harmless; a missing one is requested again, until a timeout.
    c.announce(8);
    let first = room_with_a_box()[0];
    c.item(0, &first);
    c.item(0, &first);
    assert_eq!(c.answered(), Some(MavMissionResult::MAV_MISSION_INVALID_SEQUENCE));
    let before = c.counts[&40];
    c.wait(2.5);
    assert_eq!((c.counts[&40] - before, c.asked_for()), (2, Some(1)));
    c.wait(6.5);
    assert!(c.texts_contain("Fence upload timeout"));
    assert_eq!(c.answered(), Some(MavMissionResult::MAV_MISSION_OPERATION_CANCELLED));
    assert_eq!(c.download(), kept);
}

#[test]
fn the_floor_is_active_between_climb_and_landing() {
    // Standing below the floor is not a breach, and neither is a take-off or landing through it.
    let mut c = Companion::new(config(8.0));
    c.prepare();
    c.takes_off();
    c.fly(GuidedMotion::Velocity(-DVec3::Z * 0.3), YawTarget::Angle(0.0));
    c.until(10.0, "LAND", |c| c.mode() == CopterMode::Land);
    assert!(c.texts_contain("Min Alt fence breached"), "{:?}", c.texts);
    assert!((c.p().z - 0.3).abs() < 0.1, "{:?}", c.p());
    c.until(15.0, "the disarm", |c| !c.armed());
    let breaches = |c: &Companion| match c.newest.get(&162) {
        Some(MavMessage::FENCE_STATUS(m)) => m.breach_count,
        other => panic!("{other:?}"),
    };
    c.wait(1.1);
    assert_eq!(breaches(&c), 1);
    // Nor is a flight that was never high enough to activate the floor.
    c.setpoint = None;
    assert_eq!(c.set_mode(CopterMode::Guided), ACCEPTED);
    assert_eq!(c.arm(), ACCEPTED);
    assert_eq!(c.take_off(0.4), ACCEPTED);
    c.wait(4.0);
    assert_eq!(c.mode(), CopterMode::Guided);
    assert_eq!(breaches(&c), 1);
}
