//! The lab day over HTTP: the checklist, the queue of teams, several vehicles, and the report.
//!
//! ```text
//! GET /lab                     the page; its data is GET /api/lab, JSON: a team's has its own vehicle's checks
//! GET /api/lab/report.pdf      all of it on paper ([`report`])
//! POST /api/lab/sign           a person signs a check, or takes it back
//! POST /api/lab/axes           begins or ends the check of axes by hand ([`guided`])
//! POST /api/lab/evidence       what `vizflyt doctor vehicle --report` has found
//! POST /api/lab/queue          books for a team; DELETE /api/lab/queue/ID takes it out
//! POST /api/lab/turn           calls the next team of a vehicle, passes it over, ends its turn
//! PUT /api/lab/formation       order of take-off and separation
//! POST /api/lab/begin          another day
//! ```
//! What is ordered is on the disk before it is answered ([`keep`]); [`follow`] measures.

mod follow;
mod guided;
mod keep;
mod report;

pub(crate) use follow::follow;
pub(crate) use keep::Lab;

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use vizflyt_protocol::messages::FlightPhase;

use self::guided::Guided;
use self::keep::unix_ms;
use super::access::Viewer;
use super::{Page, ordered, origin, refuse};
use crate::flights::lab_day::formation::apart_m;
use crate::flights::lab_day::{
    Booking, BookingState, CHECKS, CheckId, CheckInfo, FenceParameter, Finding, How, LabDay, Stand,
    State as CheckState, TakeOffOrder, Told,
};
use crate::flights::vehicle::VehicleFlight;
use crate::lock::lock;

/// What the page shows.
#[derive(Debug, Serialize)]
struct LabView {
    arena: String,
    is_instructor: bool,
    now_unix_ms: u64,
    began_unix_ms: u64,
    vehicles: Vec<VehicleView>,
    checks: Vec<CheckView>,
    queue: Vec<BookingView>,
    order: TakeOffOrder,
    separation_m: Option<f64>,
    /// Of all pairs of vehicles that are seen.
    distances: Vec<Distance>,
    axes: Option<AxesView>,
    /// What happened, newest first.
    story: Vec<Told>,
}

#[derive(Debug, Serialize)]
struct VehicleView {
    name: String,
    phase: FlightPhase,
    runtime: Option<String>,
    /// Whose turn it is.
    called: Option<String>,
    /// Who has checked in for the leaderboard.
    checked_in: Option<String>,
    /// Every check of it and of the room is ok.
    is_ready: bool,
    /// Why it may not start now, by the order of take-off.
    must_wait: Option<String>,
}

#[derive(Debug, Serialize)]
struct CheckView {
    check: CheckId,
    title: &'static str,
    how: How,
    ask: &'static str,
    /// Empty is the room.
    vehicle: String,
    state: CheckState,
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
    /// In its vehicle's queue, from 1, while it waits.
    place: Option<usize>,
    booked_unix_ms: u64,
    called_unix_ms: Option<u64>,
    ended_unix_ms: Option<u64>,
    passed_over: u32,
    /// Whether the viewer may take it out.
    is_own: bool,
}

/// How far two vehicles are apart.
#[derive(Debug, Serialize)]
struct Distance {
    first: String,
    second: String,
    /// Between their centres. [m]
    apart_m: f64,
}

#[derive(Debug, Serialize)]
struct AxesView {
    vehicle: String,
    ask: String,
    seen: String,
}

impl LabView {
    fn of(page: &Page, viewer: &Viewer) -> Self {
        let now_unix_ms = unix_ms();
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
            day.state(of, info.id, now_unix_ms) == CheckState::Ok
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

/// Returns how far vehicles are apart: those in the air.
fn distances(page: &Page) -> Vec<Distance> {
    let airborne = follow::airborne(&page.rooms);
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

/// `GET /api/lab`: the day, as far as the viewer may see it.
pub(super) async fn show(
    State(page): State<Arc<Page>>,
    Extension(viewer): Extension<Viewer>,
) -> Response {
    let no_store = [(header::CACHE_CONTROL, "no-store")];
    (no_store, Json(LabView::of(&page, &viewer))).into_response()
}

/// `GET /api/lab/report.pdf`: the day on paper.
pub(super) async fn report(State(page): State<Arc<Page>>) -> Response {
    let names: Vec<_> = page.rooms.flights.vehicles.iter().map(|v| v.name.as_str()).collect();
    let arena = page.rooms.flights.vehicles[0].arena.name.as_str();
    let pdf = page.lab.look(|day| report::pdf(day, arena, &names, unix_ms()));
    let heads = [
        (header::CONTENT_TYPE, "application/pdf"),
        (header::CONTENT_DISPOSITION, "inline; filename=\"lab-day.pdf\""),
        (header::CACHE_CONTROL, "no-store"),
    ];
    (heads, pdf).into_response()
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Signing {
    #[serde(default)]
    vehicle: String,
    check: CheckId,
    /// Who signs.
    name: String,
    /// The signature is taken back.
    #[serde(default)]
    take_back: bool,
}

/// `POST /api/lab/sign`: a person has looked, and signs.
pub(super) async fn sign(
    State(page): State<Arc<Page>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    change(&page, &headers, body, |page, signing: Signing| {
        let info = signing.check.info();
        if info.how != How::Signed {
            return Err(format!("'{}' is not signed: {}", info.title, info.ask));
        }
        if info.of_room != signing.vehicle.is_empty() {
            return Err(format!(
                "'{}' is {}",
                info.title,
                if info.of_room { "the room's" } else { "each vehicle's: name it" }
            ));
        }
        if !info.of_room {
            known(page, &signing.vehicle)?;
        }
        let name = signing.name.trim();
        if !(1..=40).contains(&name.chars().count()) || name.chars().any(char::is_control) {
            return Err("sign with your name, of 1 to 40 letters".to_owned());
        }
        page.lab.change(|day, now| {
            if signing.take_back {
                day.unsign(&signing.vehicle, signing.check, name, now);
            } else {
                let finding = Finding::of(format!("looked at by {name}"), &[]);
                day.record(&signing.vehicle, signing.check, finding, name, now);
            }
        });
        Ok(if signing.take_back { "taken back" } else { "signed" }.to_owned())
    })
    .await
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct AxesOrder {
    vehicle: String,
    begin: bool,
}

/// `POST /api/lab/axes`: begins the check of a vehicle's axes, or ends it without a result.
pub(super) async fn axes(
    State(page): State<Arc<Page>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    change(&page, &headers, body, |page, order: AxesOrder| {
        let vehicle = known(page, &order.vehicle)?;
        if vehicle.under_way() {
            return Err(format!("'{}' flies; land it first", vehicle.name));
        }
        let Some(source) = page.lab.source.clone() else {
            return Err("this server has no source of poses".to_owned());
        };
        let mut guided = lock(&page.lab.guided);
        *guided =
            order.begin.then(|| Guided::new(vehicle.index, source, "the page, by hand".to_owned()));
        let said = guided
            .as_ref()
            .map_or_else(|| "the check of axes is off".to_owned(), |guided| guided.ask().0);
        Ok(said)
    })
    .await
}

/// What `vizflyt doctor vehicle --report` has found.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Evidence {
    /// The vehicle, by its name on this server.
    pub vehicle: String,
    /// What was found of the autopilot's parameters.
    pub finding: Finding,
    /// FENCE_* against what the arena asks for; empty if no arena was named.
    pub fence: Vec<FenceParameter>,
    /// Where it was found.
    pub by: String,
}

/// `POST /api/lab/evidence`: takes what was found of an autopilot's parameters.
pub(super) async fn evidence(
    State(page): State<Arc<Page>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    change(&page, &headers, body, |page, brought: Evidence| {
        known(page, &brought.vehicle)?;
        let Evidence { vehicle, finding, fence, by } = brought;
        let texts = [&finding.evidence, &finding.todo, &by];
        let is_long = texts.iter().any(|text| text.chars().count() > MAX_TEXT)
            || fence.len() > MAX_FENCE
            || fence.iter().any(|p| {
                p.name.len() > 16
                    || !p.right.is_finite()
                    || p.has.is_some_and(|has| !has.is_finite())
            });
        if is_long || texts.iter().any(|text| text.chars().any(char::is_control)) {
            return Err(format!(
                "evidence has texts of {MAX_TEXT} letters and {MAX_FENCE} parameters at most"
            ));
        }
        page.lab.change(|day, now| {
            day.bring_fence(&vehicle, fence);
            day.record(&vehicle, CheckId::Parameters, finding, &by, now);
        });
        Ok(format!("noted for {vehicle}"))
    })
    .await
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BookingOrder {
    team: String,
    vehicle: String,
}

/// `POST /api/lab/queue`: books for a team on a vehicle; a team on its own.
pub(super) async fn book(
    State(page): State<Arc<Page>>,
    Extension(viewer): Extension<Viewer>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    change(&page, &headers, body, move |page, order: BookingOrder| {
        let vehicle = known(page, &order.vehicle)?.name.as_str();
        if !viewer.may_see(vehicle) {
            return Err(format!("this key is not for {vehicle}: book with that vehicle's address"));
        }
        page.lab.change(|day, now| {
            let id = day.queue.book(&order.team, vehicle, now)?;
            let place = day.queue.place(id).unwrap_or(1);
            day.tell(format!("{vehicle}: {} books, place {place}", order.team.trim()), now);
            Ok(format!("place {place} for {vehicle}"))
        })
    })
    .await
}

/// `DELETE /api/lab/queue/{id}`: takes a booking out.
pub(super) async fn withdraw(
    State(page): State<Arc<Page>>,
    Path(id): Path<u64>,
    Extension(viewer): Extension<Viewer>,
    headers: HeaderMap,
) -> Response {
    apply(&page, &headers, move |page| {
        page.lab.change(|day, now| {
            let found = day.queue.bookings().iter().find(|booking| booking.id == id);
            if found.is_some_and(|booking| !viewer.may_see(&booking.vehicle)) {
                return Err("this booking is another vehicle's".to_owned());
            }
            let team = day.queue.withdraw(id, now)?;
            day.tell(format!("{team} leaves the queue"), now);
            Ok(format!("{team} is out of the queue"))
        })
    })
    .await
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TurnOrder {
    vehicle: String,
    turn: Turn,
}

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Turn {
    Next,
    PassOver,
    End,
}

/// `POST /api/lab/turn`: calls the next team of a vehicle, passes the called one over, or ends its turn.
pub(super) async fn turn(
    State(page): State<Arc<Page>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    change(&page, &headers, body, |page, order: TurnOrder| {
        let vehicle = known(page, &order.vehicle)?.name.as_str();
        page.lab.change(|day, now| {
            let said = match order.turn {
                Turn::Next => format!("{} is called", day.queue.call_next(vehicle, now)?),
                Turn::PassOver => {
                    format!("{} goes to the end of the queue", day.queue.pass_over(vehicle)?)
                }
                Turn::End => format!("the turn of {} is over", day.queue.end(vehicle, now)?),
            };
            day.tell(format!("{vehicle}: {said}"), now);
            Ok(said)
        })
    })
    .await
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Formation {
    order: TakeOffOrder,
    separation_m: Option<f64>,
}

/// `PUT /api/lab/formation`: sets the order of take-off and the separation.
pub(super) async fn formation(
    State(page): State<Arc<Page>>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    change(&page, &headers, body, |page, Formation { order, separation_m }: Formation| {
        let names: Vec<_> = page.rooms.flights.vehicles.iter().map(|v| v.name.as_str()).collect();
        order.check(&names)?;
        page.lab.change(|day, now| {
            day.set_separation(separation_m)?;
            let keeps = separation_m.map_or("no separation".to_owned(), |m| format!("{m} m apart"));
            let who = if order.vehicles.is_empty() {
                "any".to_owned()
            } else {
                order.vehicles.join(", ")
            };
            let said = format!("order of take-off: {who}; {keeps}");
            day.order = order;
            day.tell(said.clone(), now);
            Ok(said)
        })
    })
    .await
}

/// `POST /api/lab/begin`: another day.
pub(super) async fn begin(State(page): State<Arc<Page>>, headers: HeaderMap) -> Response {
    apply(&page, &headers, |page| {
        if page.rooms.flights.any_under_way() {
            return Err("somebody flies; land first".to_owned());
        }
        page.lab.begin_anew("the page");
        Ok("a new day".to_owned())
    })
    .await
}

/// Does what a page of ours orders in JSON, and writes it down before it answers.
async fn change<T>(
    page: &Arc<Page>,
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
    order: impl FnOnce(&Page, T) -> Result<String, String> + Send + 'static,
) -> Response
where
    T: DeserializeOwned + Send + 'static,
{
    match ordered::<T>(headers, body) {
        Ok(asked) => apply(page, headers, move |page| order(page, asked)).await,
        Err(refusal) => *refusal,
    }
}

/// Does what a page of ours orders, and writes it down before it answers.
async fn apply(
    page: &Arc<Page>,
    headers: &HeaderMap,
    order: impl FnOnce(&Page) -> Result<String, String> + Send + 'static,
) -> Response {
    if let Err(refusal) = origin::check(headers) {
        return refuse(&refusal);
    }
    let page = page.clone();
    let done = tokio::task::spawn_blocking(move || {
        let done = order(&page);
        page.lab.keep();
        done
    });
    match done.await {
        Ok(Ok(said)) => (StatusCode::OK, said).into_response(),
        Ok(Err(why)) => (StatusCode::CONFLICT, why).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// Returns the vehicle of this name.
fn known<'a>(page: &'a Page, name: &str) -> Result<&'a Arc<VehicleFlight>, String> {
    page.rooms.flights.vehicles.iter().find(|vehicle| vehicle.name == name).ok_or_else(|| {
        let names: Vec<_> = page.rooms.flights.vehicles.iter().map(|v| v.name.as_str()).collect();
        format!("there is no vehicle '{name}'; there are {}", names.join(", "))
    })
}

/// What happened is listed on the page up to so much; the report has all.
const STORY_SHOWN: usize = 40;
/// Longest text of evidence. [letters]
const MAX_TEXT: usize = 2000;
/// Parameters of a fence.
const MAX_FENCE: usize = 16;

#[cfg(test)]
pub(super) fn examples() -> Vec<serde_json::Value> {
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
            state: CheckState::Ok,
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
