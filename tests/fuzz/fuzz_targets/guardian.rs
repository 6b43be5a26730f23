//! Input of a guardian: packets of a runtime, bytes of an autopilot, datagrams of the pose feed, in any order. The
//! guardian never fails, and ends in time.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_guardian::port::Wanted;
use vizflyt_guardian::watch::{Out, Watch};
use vizflyt_protocol::packet::feed::{FeedMessage, MAX_FEED, open, seal};
use vizflyt_protocol::time::HostTime;

struct Sent(u64);

impl Out for Sent {
    fn send(&mut self, packet: &[u8]) {
        assert!(packet.len() <= 2048);
        self.0 += 1;
    }

    fn say(&mut self, sentence: &'static str) {
        assert!(!sentence.is_empty());
    }
}

fuzz_target!(|bytes: &[u8]| {
    let mut now = HostTime::from_ns(1_000_000_000);
    let (mut watch, mut sent) = (Watch::new(now, Wanted::default()), Sent(0));
    let (key, mut rest) = ([7; 32], bytes);
    // One byte for source and delay, one for the length.
    while let [what, len, tail @ ..] = rest {
        let (part, after) = tail.split_at(usize::from(*len).min(tail.len()));
        rest = after;
        now = now.plus_ns(i64::from(what >> 2) * 10_000_000);
        match what % 4 {
            0 => watch.handle_runtime(now, part, &mut sent),
            1 => watch.handle_autopilot(now, part),
            2 => {
                assert_eq!(open(&key, part), None);
                let mut buffer = [0; MAX_FEED];
                let message: Option<FeedMessage> = postcard::from_bytes(part).ok();
                let opened =
                    message.and_then(|message| open(&key, seal(&key, &message, &mut buffer)));
                if let Some(FeedMessage::Pose(pose)) = opened {
                    watch.handle_pose(now, &pose, now, &mut sent);
                }
            }
            _ => watch.handle_timeout(now, &mut sent),
        }
        let _ = watch.is_over(now);
    }
    watch.handle_end();
    watch.handle_timeout(now, &mut sent);
    assert!(watch.is_over(now.plus_seconds(60.0)), "it does not end");
});
