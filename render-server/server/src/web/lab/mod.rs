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
pub(super) mod guided;
pub(super) mod keep;
pub(super) mod report;

pub(super) use follow::airborne;
pub(crate) use follow::follow;
pub(crate) use keep::Lab;
