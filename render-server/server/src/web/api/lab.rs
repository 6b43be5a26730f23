use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::lab_view::LabView;
#[cfg(test)]
pub(in crate::web) use super::lab_view::examples;
use crate::flights::lab_day::{CheckId, FenceParameter, Finding, How, TakeOffOrder};
use crate::flights::vehicle::VehicleFlight;
use crate::web::access::Viewer;
use crate::web::http::{ordered, refuse};
use crate::web::lab::guided::Guided;
use crate::web::lab::keep::unix_ms;
use crate::web::lab::report;
use crate::web::origin;
use crate::web::state::Page;
use vizflyt_process::lock;

/// `GET /api/lab`: the parts of the day that the viewer may see.
pub(in crate::web) async fn show(
    State(page): State<Arc<Page>>,
    Extension(viewer): Extension<Viewer>,
) -> Response {
    let no_store = [(header::CACHE_CONTROL, "no-store")];
    (no_store, Json(LabView::of(&page, &viewer))).into_response()
}

/// `GET /api/lab/report.pdf`: the report of the day.
pub(in crate::web) async fn report(State(page): State<Arc<Page>>) -> Response {
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
pub(in crate::web) struct Signing {
    #[serde(default)]
    vehicle: String,
    check: CheckId,
    /// Name of the person who signs.
    name: String,
    /// Whether to withdraw the signature.
    #[serde(default)]
    take_back: bool,
}

/// `POST /api/lab/sign`: a person signs a check.
pub(in crate::web) async fn sign(
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
pub(in crate::web) struct AxesOrder {
    vehicle: String,
    begin: bool,
}

/// `POST /api/lab/axes`: begins the check of a vehicle's axes, or ends it without a result.
pub(in crate::web) async fn axes(
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
            return Err(
                "this server has no source of poses; add [[localization]] to arena.toml".to_owned()
            );
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

/// Findings of `vizflyt doctor vehicle --report`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Evidence {
    /// Name of the vehicle on this server.
    pub vehicle: String,
    /// Findings about the autopilot's parameters.
    pub finding: Finding,
    /// FENCE_* parameters compared with the arena; empty without an arena.
    pub fence: Vec<FenceParameter>,
    /// Source of the findings.
    pub by: String,
}

/// `POST /api/lab/evidence`: records findings about an autopilot's parameters.
pub(in crate::web) async fn evidence(
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
pub(in crate::web) struct BookingOrder {
    team: String,
    vehicle: String,
}

/// `POST /api/lab/queue`: books a vehicle for a team. A team may book only its own vehicle.
pub(in crate::web) async fn book(
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

/// `DELETE /api/lab/queue/{id}`: removes a booking.
pub(in crate::web) async fn withdraw(
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
pub(in crate::web) struct TurnOrder {
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
pub(in crate::web) async fn turn(
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
pub(in crate::web) struct Formation {
    order: TakeOffOrder,
    separation_m: Option<f64>,
}

/// `PUT /api/lab/formation`: sets the order of take-off and the separation.
pub(in crate::web) async fn formation(
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

/// `POST /api/lab/begin`: begins another day.
pub(in crate::web) async fn begin(State(page): State<Arc<Page>>, headers: HeaderMap) -> Response {
    apply(&page, &headers, |page| {
        if page.rooms.flights.any_under_way() {
            return Err("a vehicle is flying; land it first".to_owned());
        }
        page.lab.begin_anew("the page");
        Ok("a new day".to_owned())
    })
    .await
}

/// Executes a JSON request of the page, and writes the change to the disk before the response.
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

/// Executes a request of the page, and writes the change to the disk before the response.
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
        (done, page.lab.keep())
    });
    match done.await {
        Ok((Ok(said), Ok(()))) => (StatusCode::OK, said).into_response(),
        Ok((Ok(said), Err(error))) => {
            let text = format!("{said}, but it could not be saved: {error}; retrying");
            (StatusCode::INSUFFICIENT_STORAGE, text).into_response()
        }
        Ok((Err(why), _)) => (StatusCode::CONFLICT, why).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

fn known<'a>(page: &'a Page, name: &str) -> Result<&'a Arc<VehicleFlight>, String> {
    page.rooms.flights.vehicles.iter().find(|vehicle| vehicle.name == name).ok_or_else(|| {
        let names: Vec<_> = page.rooms.flights.vehicles.iter().map(|v| v.name.as_str()).collect();
        format!("there is no vehicle '{name}'; there are {}", names.join(", "))
    })
}

/// Maximum length of an evidence text. [letters]
const MAX_TEXT: usize = 2000;
/// Maximum number of fence parameters.
const MAX_FENCE: usize = 16;
