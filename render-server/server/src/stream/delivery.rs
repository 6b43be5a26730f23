//! The delivery statistics of every image that was rendered for a runtime: delivered, in flight, or
//! skipped and why.
//!
//! ```text
//! render ─ rendered ─▶ encode ─ handed ─▶ transport ─ late ─▶ .  counted here, by camera
//! runtime ─ arrived, delivered, stale, ... ─▶ DeliveryStats             reported once a second
//! ```
//! Both sides only count up. What is handed over and has not arrived is in flight, or late as far
//! as the transport has given it up; so the sum is the number of rendered images, at any moment.

use std::sync::atomic::{AtomicU64, Ordering};

use serde::{Deserialize, Serialize};
use vizflyt_protocol::messages::{Arrivals, MAX_CAMERAS};

/// Running counts of one camera's images.
#[derive(Debug, Default)]
pub struct CameraCounters {
    rendered: AtomicU64,
    handed: AtomicU64,
    failed: AtomicU64,
    late: AtomicU64,
}

impl CameraCounters {
    /// Counts an image rendered while a runtime flies.
    pub fn count_rendered(&self) {
        self.rendered.fetch_add(1, Ordering::SeqCst);
    }

    /// Counts an image handed to the runtime's transport; `counted` is whether it was when it was
    /// rendered: the first one of a session may have been rendered for nobody.
    pub fn count_sent(&self, counted: bool) {
        if !counted {
            self.count_rendered();
        }
        self.handed.fetch_add(1, Ordering::SeqCst);
    }

    /// Counts a rendered image that could not be encoded.
    pub fn count_failed(&self, counted: bool) {
        if !counted {
            self.count_rendered();
        }
        self.failed.fetch_add(1, Ordering::SeqCst);
    }

    /// Counts an image that the transport gave up.
    pub fn count_late(&self) {
        self.late.fetch_add(1, Ordering::SeqCst);
    }

    /// Returns the counts of this moment.
    pub fn counts(&self) -> Counts {
        // What ends an image is read before what begins it, so that no sum exceeds its parts.
        let late = self.late.load(Ordering::SeqCst);
        let (failed, handed) =
            (self.failed.load(Ordering::SeqCst), self.handed.load(Ordering::SeqCst));
        Counts { late, failed, handed, rendered: self.rendered.load(Ordering::SeqCst) }
    }
}

/// Counts of one camera's images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Rendered while a runtime flies.
    pub rendered: u64,
    /// Handed to its transport.
    pub handed: u64,
    /// Not encoded for an error.
    pub failed: u64,
    /// Given up by the transport.
    pub late: u64,
}

impl Counts {
    fn since(self, start: Self) -> Self {
        Self {
            rendered: self.rendered.saturating_sub(start.rendered),
            handed: self.handed.saturating_sub(start.handed),
            failed: self.failed.saturating_sub(start.failed),
            late: self.late.saturating_sub(start.late),
        }
    }
}

/// The delivery of one camera's images in the present flight; `rendered` is the sum of the rest.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Delivery {
    /// Rendered.
    #[serde(rename = "drawn")]
    pub rendered: u64,
    /// Given to the plugin.
    pub delivered: u64,
    /// Neither ended nor reported yet.
    pub under_way: u64,
    /// Skipped, by reason.
    pub skipped: Skipped,
}

/// The delivery of one camera's images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraDelivery {
    /// Its name.
    pub camera: String,
    /// The counts.
    #[serde(flatten)]
    pub account: Delivery,
}

/// Images skipped, by reason, in the order of their way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Skipped {
    /// Rendered, but a newer one was before the encoder was free and the transport had room.
    pub no_room: u64,
    /// Could not be encoded.
    pub failed: u64,
    /// Given up by the transport: past its deadline, reset, or the connection broke.
    pub late: u64,
    /// Arrived when a newer one was there already.
    pub stale: u64,
    /// Arrived, but did not decode.
    pub broken: u64,
    /// Arrived; a newer one came before the decoder was free.
    pub superseded: u64,
    /// Decoded; a newer one was there before the plugin, idle, had asked.
    pub unasked: u64,
    /// Decoded; a newer one was there before the plugin had done with an earlier one.
    pub overrun: u64,
}

impl Skipped {
    /// Returns all of them with their names, in order.
    pub fn each(&self) -> [(&'static str, u64); 8] {
        [
            ("no_room", self.no_room),
            ("failed", self.failed),
            ("late", self.late),
            ("stale", self.stale),
            ("broken", self.broken),
            ("superseded", self.superseded),
            ("unasked", self.unasked),
            ("overrun", self.overrun),
        ]
    }

    /// Returns their sum.
    pub fn sum(&self) -> u64 {
        self.each().iter().map(|(_, count)| count).sum()
    }
}

impl Delivery {
    /// Joins what the server counted with what the runtime reported before that.
    pub fn of(server: Counts, runtime: Arrivals) -> Self {
        let arrived = runtime.arrived.min(server.handed);
        let on_the_way = server.handed - arrived;
        let late = server.late.min(on_the_way);
        let skipped = Skipped {
            no_room: server.rendered.saturating_sub(server.handed + server.failed),
            failed: server.failed,
            late,
            stale: runtime.stale,
            broken: runtime.broken,
            superseded: runtime.superseded,
            unasked: runtime.unasked,
            overrun: runtime.overrun,
        };
        let waiting = arrived.saturating_sub(runtime.ended());
        Self {
            rendered: server.rendered,
            delivered: runtime.delivered,
            under_way: on_the_way - late + waiting,
            skipped,
        }
    }
}

/// The accounts of one vehicle's present flight.
#[derive(Debug, Default)]
pub struct DeliveryStats {
    /// The server's counts when the flight began.
    start: [Counts; MAX_CAMERAS],
    /// The runtime's newest report.
    newest: [Arrivals; MAX_CAMERAS],
    /// What a runtime that was restarted in flight had reported before.
    before: [Arrivals; MAX_CAMERAS],
}

impl DeliveryStats {
    /// Begins a flight.
    pub fn begin(&mut self, counters: &[CameraCounters; MAX_CAMERAS]) {
        *self = Self {
            start: std::array::from_fn(|camera| counters[camera].counts()),
            ..Self::default()
        };
    }

    /// Takes the runtime's report, by camera.
    pub fn report(&mut self, cameras: &[Arrivals]) {
        let restarted =
            cameras.iter().zip(&self.newest).any(|(now, last)| now.arrived < last.arrived);
        if restarted {
            for (before, last) in self.before.iter_mut().zip(&self.newest) {
                *before = add(*before, *last);
            }
            self.newest = [Arrivals::default(); MAX_CAMERAS];
        }
        for (newest, now) in self.newest.iter_mut().zip(cameras) {
            *newest = *now;
        }
    }

    /// Returns the account of a camera.
    pub fn account(&self, camera: usize, counters: &CameraCounters) -> Delivery {
        let runtime = add(self.before[camera], self.newest[camera]);
        Delivery::of(counters.counts().since(self.start[camera]), runtime)
    }
}

fn add(a: Arrivals, b: Arrivals) -> Arrivals {
    Arrivals {
        arrived: a.arrived + b.arrived,
        delivered: a.delivered + b.delivered,
        stale: a.stale + b.stale,
        broken: a.broken + b.broken,
        superseded: a.superseded + b.superseded,
        unasked: a.unasked + b.unasked,
        overrun: a.overrun + b.overrun,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Where an image's way ends.
    #[derive(Clone, Copy, Debug, PartialEq)]
    enum End {
        NoRoom,
        Failed,
        /// Handed over, given up, never arrives.
        Late,
        /// Given up by the server, and arrived all the same: the last acknowledgement was lost.
        LateButDelivered,
        Delivered,
        Stale,
        Broken,
        Superseded,
        Unasked,
        Overrun,
    }

    const ENDS: [End; 10] = [
        End::NoRoom,
        End::Failed,
        End::Late,
        End::LateButDelivered,
        End::Delivered,
        End::Stale,
        End::Broken,
        End::Superseded,
        End::Unasked,
        End::Overrun,
    ];

    fn serve(counters: &CameraCounters, end: End, counted: bool) {
        if counted {
            counters.count_rendered();
        }
        match end {
            End::NoRoom => {
                if !counted {
                    counters.count_rendered();
                }
            }
            End::Failed => counters.count_failed(counted),
            _ => counters.count_sent(counted),
        }
        if matches!(end, End::Late | End::LateButDelivered) {
            counters.count_late();
        }
    }

    fn arrive(runtime: &mut Arrivals, end: End) {
        let count = match end {
            End::NoRoom | End::Failed | End::Late => return,
            End::Delivered | End::LateButDelivered => &mut runtime.delivered,
            End::Stale => &mut runtime.stale,
            End::Broken => &mut runtime.broken,
            End::Superseded => &mut runtime.superseded,
            End::Unasked => &mut runtime.unasked,
            End::Overrun => &mut runtime.overrun,
        };
        *count += 1;
        runtime.arrived += 1;
    }

    fn sum(account: &Delivery) -> u64 {
        account.delivered + account.under_way + account.skipped.sum()
    }

    proptest! {
        /// Every image that is rendered is accounted for: at any moment by the sum, in the end by its
        /// own reason, though reports lag behind and the runtime is restarted in flight.
        #[test]
        fn every_rendered_image_is_accounted_for(
            script in prop::collection::vec((0usize..ENDS.len(), any::<bool>(), 0u8..20), 1..400),
            restart_at in 0usize..400,
            former in 0usize..50,
        ) {
            let counters: [CameraCounters; MAX_CAMERAS] = std::array::from_fn(|_| CameraCounters::default());
            let counter = &counters[3];
            // A former flight leaves its counts behind.
            for index in 0..former {
                serve(counter, ENDS[index % ENDS.len()], true);
            }
            let mut delivery = DeliveryStats::default();
            delivery.begin(&counters);
            let (mut runtime, mut truth) = ([Arrivals::default(); MAX_CAMERAS], [0u64; ENDS.len()]);
            let (mut late_arrivals, mut arrived) = (Vec::new(), 0);
            for (step, &(index, counted, lag)) in script.iter().enumerate() {
                let end = ENDS[index];
                serve(counter, end, counted);
                truth[index] += 1;
                if lag < 5 {
                    late_arrivals.push(end);
                } else {
                    arrive(&mut runtime[3], end);
                }
                if lag == 7 {
                    delivery.report(&runtime);
                }
                if step == restart_at {
                    delivery.report(&runtime);
                    arrived += runtime[3].arrived;
                    runtime = [Arrivals::default(); MAX_CAMERAS];
                    delivery.report(&runtime);
                }
                let account = delivery.account(3, counter);
                prop_assert_eq!(account.rendered, step as u64 + 1);
                prop_assert_eq!(sum(&account), account.rendered);
            }
            for end in late_arrivals {
                arrive(&mut runtime[3], end);
            }
            delivery.report(&runtime);
            let found = delivery.account(3, counter);
            prop_assert!(found.delivered <= arrived + runtime[3].arrived);
            let of = |end| truth[ENDS.iter().position(|&e| e == end).unwrap()];
            let expected = Delivery {
                rendered: script.len() as u64,
                delivered: of(End::Delivered) + of(End::LateButDelivered),
                under_way: 0,
                skipped: Skipped {
                    no_room: of(End::NoRoom),
                    failed: of(End::Failed),
                    late: of(End::Late),
                    stale: of(End::Stale),
                    broken: of(End::Broken),
                    superseded: of(End::Superseded),
                    unasked: of(End::Unasked),
                    overrun: of(End::Overrun),
                },
            };
            prop_assert_eq!(found, expected);
            prop_assert_eq!(delivery.account(0, &counters[0]), Delivery::default());
        }
    }

    #[test]
    fn a_runtime_that_reports_nonsense_breaks_nothing() {
        let counters = CameraCounters::default();
        counters.count_sent(false);
        let most = u64::MAX / 16;
        let absurd =
            Arrivals { arrived: most, delivered: most, stale: most, ..Arrivals::default() };
        let mut delivery = DeliveryStats::default();
        delivery.report(&[absurd; 20]);
        assert_eq!(delivery.account(0, &counters).under_way, 0);
    }
}
