//! The lab day over HTTP: checklist, queue of teams, several vehicles, report.
//!
//! ```text
//! GET /lab                     page; its data is GET /api/lab, JSON; a team gets the checks of its vehicle
//! GET /api/lab/report.pdf      complete report ([`report`])
//! POST /api/lab/sign           a person signs a check, or withdraws the signature
//! POST /api/lab/axes           begins or ends the check of axes by hand ([`guided`])
//! POST /api/lab/evidence       findings of `vizflyt doctor vehicle --report`
//! POST /api/lab/queue          books for a team; DELETE /api/lab/queue/ID removes the booking
//! POST /api/lab/turn           calls the next team of a vehicle, passes it over, ends its turn
//! PUT /api/lab/formation       order of take-off and separation
//! POST /api/lab/begin          begins another day
//! ```
//! Changes are on the disk before the response ([`keep`]); [`follow`] measures.

mod follow;
pub(super) mod guided;
pub(super) mod keep;
pub(super) mod report;

pub(super) use follow::airborne;
pub(crate) use follow::follow;
pub(crate) use keep::Lab;
