//! Data of the lab day's page: everything for the instructor; one vehicle and the queue for a team.

use serde::Serialize;
use vizflyt_protocol::messages::FlightPhase;

use crate::flights::lab_day::formation::apart_m;
use crate::flights::lab_day::{
    Booking, BookingState, CHECKS, CheckId, CheckInfo, How, LabDay, Stand, State, TakeOffOrder,
    Told,
};
use crate::flights::vehicle::VehicleFlight;
use crate::web::access::Viewer;
use crate::web::lab::{airborne, keep};
use crate::web::state::Page;
use vizflyt_process::lock;

#[derive(Debug, Serialize)]
pub(in crate::web) struct LabView {
    arena: String,
    is_instructor: bool,
    now_unix_ms: u64,
    began_unix_ms: u64,
    vehicles: Vec<VehicleView>,
    checks: Vec<CheckView>,
    queue: Vec<BookingView>,
    order: TakeOffOrder,
    separation_m: Option<f64>,
    /// Distances between all pairs of vehicles in the air.
    distances: Vec<Distance>,
    axes: Option<AxesView>,
    /// Log of the day, newest first.
    story: Vec<Told>,
}

#[derive(Debug, Serialize)]
struct VehicleView {
    name: String,
    phase: FlightPhase,
    runtime: Option<String>,
    /// Team whose turn it is.
    called: Option<String>,
    /// Team that has checked in for the leaderboard.
    checked_in: Option<String>,
    /// Whether all checks of the vehicle and of the room are ok.
    is_ready: bool,
    /// Reason why it may not start now, by the order of take-off.
    must_wait: Option<String>,
}

#[derive(Debug, Serialize)]
struct CheckView {
    check: CheckId,
    title: &'static str,
    how: How,
    ask: &'static str,
    /// Name of the vehicle; empty for checks of the room.
    vehicle: String,
    state: State,
    evidence: String,
    todo: String,
    at_unix_ms: Option<u64>,
    by: String,
}

#[derive(Debug, Serialize)]
struct BookingView {
    id: u64,
    team: String,
    vehicle: String,
    state: BookingState,
    /// Position in the vehicle's queue, from 1, while waiting.
    place: Option<usize>,
    booked_unix_ms: u64,
    called_unix_ms: Option<u64>,
    ended_unix_ms: Option<u64>,
    passed_over: u32,
    /// Whether the viewer may remove it.
    is_own: bool,
}

/// Distance of two vehicles.
#[derive(Debug, Serialize)]
struct Distance {
    first: String,
    second: String,
    /// Distance between their centres. [m]
    apart_m: f64,
}

#[derive(Debug, Serialize)]
struct AxesView {
    vehicle: String,
    ask: String,
    seen: String,
}

impl LabView {
    pub(in crate::web) fn of(page: &Page, viewer: &Viewer) -> Self {
        let now_unix_ms = keep::unix_ms();
        let vehicles: Vec<_> =
            page.rooms.flights.vehicles.iter().filter(|v| viewer.may_see(&v.name)).collect();
        let is_instructor = *viewer == Viewer::Instructor;
        let axes = lock(&page.lab.guided).as_ref().map(|guided| {
            let (ask, seen) = guided.ask();
            let vehicle = page.rooms.flights.vehicles[guided.vehicle].name.as_str().to_owned();
            AxesView { vehicle, ask, seen }
        });
        page.lab.look(|day| Self {
            arena: page.rooms.flights.vehicles[0].arena.name.as_str().to_owned(),
            is_instructor,
            now_unix_ms,
            began_unix_ms: day.began_unix_ms,
            vehicles: vehicles
                .iter()
                .map(|vehicle| VehicleView::of(page, day, vehicle, now_unix_ms))
                .collect(),
            checks: checks(day, vehicles.iter().map(|v| v.name.as_str()), now_unix_ms),
            queue: bookings(day, viewer),
            order: day.order.clone(),
            separation_m: day.separation_m,
            distances: if is_instructor { distances(page) } else { Vec::new() },
            axes: axes.filter(|axes| viewer.may_see(&axes.vehicle)),
            story: if is_instructor { newest(day) } else { Vec::new() },
        })
    }
}

impl VehicleView {
    fn of(page: &Page, day: &LabDay, vehicle: &VehicleFlight, now_unix_ms: u64) -> Self {
        let name = vehicle.name.as_str();
        let is_ok = |info: &CheckInfo| {
            let of = if info.of_room { "" } else { name };
            day.state(of, info.id, now_unix_ms) == State::Ok
        };
        let stand =
            |name: &str| page.rooms.flights.vehicle(name).map_or(Stand::Below, |v| keep::stand(v));
        let checked_in = lock(&vehicle.checked_in).as_ref().map(|by| by.team.clone());
        Self {
            name: name.to_owned(),
            phase: vehicle.phase(),
            runtime: vehicle.runtime().map(|runtime| runtime.program.to_string()),
            called: day.queue.called(name).map(|booking| booking.team.clone()),
            checked_in,
            is_ready: CHECKS.iter().all(is_ok),
            must_wait: day.order.may_start(name, stand).err(),
        }
    }
}

/// Returns all checks: those of the room, then those of each vehicle.
fn checks<'a>(
    day: &LabDay,
    vehicles: impl Iterator<Item = &'a str>,
    now_unix_ms: u64,
) -> Vec<CheckView> {
    let of = |vehicle: &str, of_room: bool| -> Vec<_> {
        let own = CHECKS.iter().filter(|info| info.of_room == of_room);
        own.map(|info| CheckView::of(day, vehicle, info, now_unix_ms)).collect()
    };
    let room = of("", true);
    room.into_iter().chain(vehicles.flat_map(|name| of(name, false))).collect()
}

impl CheckView {
    fn of(day: &LabDay, vehicle: &str, info: &CheckInfo, now_unix_ms: u64) -> Self {
        let record = day.evidence(vehicle, info.id);
        Self {
            check: info.id,
            title: info.title,
            how: info.how,
            ask: info.ask,
            vehicle: vehicle.to_owned(),
            state: day.state(vehicle, info.id, now_unix_ms),
            evidence: record.map_or_else(String::new, |record| record.finding.evidence.clone()),
            todo: record.map_or_else(String::new, |record| record.finding.todo.clone()),
            at_unix_ms: record.map(|record| record.at_unix_ms),
            by: record.map_or_else(String::new, |record| record.by.clone()),
        }
    }
}

fn bookings(day: &LabDay, viewer: &Viewer) -> Vec<BookingView> {
    let view = |booking: &Booking| BookingView {
        id: booking.id,
        team: booking.team.clone(),
        vehicle: booking.vehicle.clone(),
        state: booking.state,
        place: day.queue.place(booking.id),
        booked_unix_ms: booking.booked_unix_ms,
        called_unix_ms: booking.called_unix_ms,
        ended_unix_ms: booking.ended_unix_ms,
        passed_over: booking.passed_over,
        is_own: viewer.may_see(&booking.vehicle),
    };
    day.queue.bookings().iter().map(view).collect()
}

/// Returns the distances between vehicles in the air.
fn distances(page: &Page) -> Vec<Distance> {
    let airborne = airborne(&page.rooms);
    let name = |index: usize| page.rooms.flights.vehicles[index].name.as_str().to_owned();
    let mut found = Vec::new();
    for (at, a) in airborne.iter().enumerate() {
        for b in &airborne[at + 1..] {
            found.push(Distance {
                first: name(a.vehicle),
                second: name(b.vehicle),
                apart_m: apart_m(a, b),
            });
        }
    }
    found
}

fn newest(day: &LabDay) -> Vec<Told> {
    let mut story: Vec<_> = day.story().cloned().collect();
    story.reverse();
    story.truncate(STORY_SHOWN);
    story
}

/// Maximum log entries on the page; the report has all.
const STORY_SHOWN: usize = 40;

#[cfg(test)]
pub(in crate::web) fn examples() -> Vec<serde_json::Value> {
    use crate::flights::lab_day::Until;

    let text = || "wasp".to_owned();
    let view = |full: bool| LabView {
        arena: text(),
        is_instructor: full,
        now_unix_ms: 1,
        began_unix_ms: 1,
        vehicles: vec![VehicleView {
            name: text(),
            phase: FlightPhase::Waiting,
            runtime: full.then(text),
            called: full.then(text),
            checked_in: full.then(text),
            is_ready: full,
            must_wait: full.then(text),
        }],
        checks: vec![CheckView {
            check: CheckId::Net,
            title: "net closed",
            how: How::Signed,
            ask: "sign",
            vehicle: text(),
            state: State::Ok,
            evidence: text(),
            todo: text(),
            at_unix_ms: full.then_some(1),
            by: text(),
        }],
        queue: vec![BookingView {
            id: 1,
            team: text(),
            vehicle: text(),
            state: BookingState::Waiting,
            place: full.then_some(1),
            booked_unix_ms: 1,
            called_unix_ms: full.then_some(1),
            ended_unix_ms: full.then_some(1),
            passed_over: 0,
            is_own: full,
        }],
        order: TakeOffOrder { vehicles: vec![text()], until: Until::Up },
        separation_m: full.then_some(1.0),
        distances: vec![Distance { first: text(), second: text(), apart_m: 1.0 }],
        axes: full.then(|| AxesView { vehicle: text(), ask: text(), seen: text() }),
        story: vec![Told { at_unix_ms: 1, text: text() }],
    };
    [true, false].map(|full| serde_json::json!(view(full))).into()
}
