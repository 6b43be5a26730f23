//! Delivery statistics of images rendered for a runtime: delivered, in flight, or skipped with the reason.
//!
//! ```text
//! render ─ rendered ─▶ encode ─ handed ─▶ transport ─ late ─▶ .  counted here, by camera
//! runtime ─ arrived, delivered, stale, ... ─▶ DeliveryStats             reported once a second
//! ```
//! Both sides only count up. An image that was handed over and has not arrived is in flight, or late if the
//! transport has given it up. So the counts add up to the number of rendered images at any moment.

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

    /// Counts an image handed to the runtime's transport. `counted`: the image was already counted when it was
    /// rendered. The first image of a session may have been rendered before the session began.
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

    /// Returns the current counts.
    pub fn counts(&self) -> Counts {
        // Ends of images are read before their starts, so that no sum exceeds its parts.
        let late = self.late.load(Ordering::SeqCst);
        let (failed, handed) =
            (self.failed.load(Ordering::SeqCst), self.handed.load(Ordering::SeqCst));
        Counts { late, failed, handed, rendered: self.rendered.load(Ordering::SeqCst) }
    }
}

/// Counts of one camera's images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Rendered during a runtime's flight.
    pub rendered: u64,
    /// Handed to the runtime's transport.
    pub handed: u64,
    /// Not encoded because of an error.
    pub failed: u64,
    /// Dropped by the transport.
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

/// Delivery of one camera's images in the present flight; `rendered` is the sum of the other counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Delivery {
    /// Rendered.
    #[serde(rename = "drawn")]
    pub rendered: u64,
    /// Passed to the plugin.
    pub delivered: u64,
    /// Neither finished nor reported yet.
    pub under_way: u64,
    /// Skipped, by reason.
    pub skipped: Skipped,
}

/// The delivery of one camera's images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraDelivery {
    pub camera: String,
    #[serde(flatten)]
    pub account: Delivery,
}

/// Skipped images by reason, in the order of the stages from renderer to plugin.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Skipped {
    /// Rendered, but replaced by a newer image before encoder and transport had room.
    pub no_room: u64,
    /// Could not be encoded.
    pub failed: u64,
    /// Dropped by the transport: deadline passed, stream reset, or connection lost.
    pub late: u64,
    /// Arrived after a newer image.
    pub stale: u64,
    /// Arrived, but did not decode.
    pub broken: u64,
    /// Arrived, but replaced by a newer image before the decoder was free.
    pub superseded: u64,
    /// Decoded, but replaced by a newer image before the idle plugin requested one.
    pub unasked: u64,
    /// Decoded, but replaced by a newer image while the plugin processed an earlier one.
    pub overrun: u64,
}

impl Skipped {
    /// Returns all counts with their names, in order.
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

    pub fn sum(&self) -> u64 {
        self.each().iter().map(|(_, count)| count).sum()
    }
}

impl Delivery {
    /// Combines the server's counts with the runtime's earlier report.
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

/// Delivery statistics of one vehicle's present flight.
#[derive(Debug, Default)]
pub struct DeliveryStats {
    /// Counts of the server at the start of the flight.
    start: [Counts; MAX_CAMERAS],
    /// The runtime's newest report.
    newest: [Arrivals; MAX_CAMERAS],
    /// Sum of the reports before the runtime was restarted in flight.
    before: [Arrivals; MAX_CAMERAS],
}

impl DeliveryStats {
    pub fn begin(&mut self, counters: &[CameraCounters; MAX_CAMERAS]) {
        *self = Self {
            start: std::array::from_fn(|camera| counters[camera].counts()),
            ..Self::default()
        };
    }

    /// Records the runtime's report, by camera.
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

    /// Returns the delivery of a camera's images.
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

    /// Stage at which an image ends.
    #[derive(Clone, Copy, Debug, PartialEq)]
    enum End {
        NoRoom,
        Failed,
        /// Handed over, dropped, never arrives.
        Late,
        /// Dropped by the server but arrived: the last acknowledgement was lost.
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
        /// Every rendered image is counted: the sum is right at any moment, and in the end each image has its
        /// own reason, even if reports are delayed and the runtime is restarted in flight.
        #[test]
        fn every_rendered_image_is_accounted_for(
            script in prop::collection::vec((0usize..ENDS.len(), any::<bool>(), 0u8..20), 1..400),
            restart_at in 0usize..400,
            former in 0usize..50,
        ) {
            let counters: [CameraCounters; MAX_CAMERAS] = std::array::from_fn(|_| CameraCounters::default());
            let counter = &counters[3];
            // An earlier flight leaves its counts behind.
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
    fn inconsistent_reports_do_not_break_the_counts() {
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
