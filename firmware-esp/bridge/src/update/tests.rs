extern crate std;

use std::vec;
use std::vec::Vec;

use ed25519_dalek::{Signer, SigningKey};
use proptest::prelude::*;

use super::*;
use crate::storage::tests::Memory;

const SECRET: [u8; 32] = [5; 32];

fn signer() -> SigningKey {
    SigningKey::from_bytes(&SECRET)
}

fn wanted() -> Wanted {
    Wanted { target: Target::Host, build: 7, key: signer().verifying_key().to_bytes() }
}

fn firmware(len: usize) -> Vec<u8> {
    (0..len).map(|at| (at * 31 % 251) as u8).collect()
}

fn signed_firmware(body: &[u8], change: impl FnOnce(&mut Header)) -> Vec<u8> {
    let mut header =
        Header { target: 0, build: 8, len: body.len() as u32, hash: Sha256::digest(body).into() };
    change(&mut header);
    let head = header.sign(|message| signer().sign(message).to_bytes());
    [&head[..], body].concat()
}

struct Halves {
    spare: Memory,
    starts_spare: bool,
}

impl Slots for Halves {
    type Spare = Memory;

    fn spare(&mut self) -> &mut Memory {
        &mut self.spare
    }

    fn start_spare(&mut self) -> bool {
        self.starts_spare = true;
        true
    }
}

fn halves() -> Halves {
    Halves { spare: Memory::of(4 * 4096), starts_spare: false }
}

fn feed(halves: &mut Halves, bytes: &[u8], chunk: usize) -> Result<bool, Fault> {
    let mut updater = Updater::new(wanted());
    let mut whole = false;
    for part in bytes.chunks(chunk) {
        whole = updater.feed(halves, part)?;
    }
    Ok(whole)
}

proptest! {
    #[test]
    fn accepts_a_signed_firmware_in_any_portions(len in 1..16384usize, chunk in 1..2000usize) {
        let body = firmware(len);
        let mut halves = halves();
        prop_assert_eq!(feed(&mut halves, &signed_firmware(&body, |_| {}), chunk), Ok(true));
        prop_assert!(halves.starts_spare);
        prop_assert_eq!(&halves.spare.bytes[..len], &body[..]);
    }
}

#[test]
fn rejects_other_firmware_before_erasing() {
    let body = firmware(5000);
    let check = |bytes: &[u8], expected: Fault| {
        let mut halves = halves();
        halves.spare.bytes.fill(0xA5);
        assert_eq!(feed(&mut halves, bytes, 100), Err(expected));
        assert!(!halves.starts_spare);
        assert!(halves.spare.bytes.iter().all(|&byte| byte == 0xA5), "{expected:?} erased");
    };
    check(&signed_firmware(&body, |header| header.target = 1), Fault::OtherChip);
    check(&signed_firmware(&body, |header| header.build = 6), Fault::Older);
    check(&signed_firmware(&body, |header| header.len = 1 << 20), Fault::TooLong);
    check(&signed_firmware(&body, |header| header.len = 0), Fault::TooLong);
    check(&body, Fault::NoFirmware);
    for at in [4, 9, 13, 20, 60, 111] {
        let mut forged = signed_firmware(&body, |_| {});
        forged[at] ^= 1;
        check(&forged, Fault::Signature);
    }
}

#[test]
fn detects_damage_behind_the_header() {
    let whole = signed_firmware(&firmware(5000), |_| {});
    let check = |bytes: &[u8], expected: Result<bool, Fault>| {
        let mut halves = halves();
        assert_eq!(feed(&mut halves, bytes, 100), expected);
        assert!(!halves.starts_spare);
    };
    let mut changed = whole.clone();
    changed[3000] ^= 1;
    check(&changed, Err(Fault::Damaged));
    check(&whole[..whole.len() - 1], Ok(false));
    // The power fails during a write.
    let mut halves = halves();
    halves.spare.power = 6000;
    assert_eq!(feed(&mut halves, &whole, 100), Err(Fault::Flash));
    assert!(!halves.starts_spare);
}

#[test]
fn rolls_back_after_three_unhealthy_starts() {
    let mut trial = Trial::new(Memory::of(4096), 0);
    assert_eq!(trial.start(), Ok(StartAction::Settled), "nothing was ever updated");
    trial.begin().unwrap();
    for _ in 0..STARTS {
        assert_eq!(trial.start(), Ok(StartAction::OnTrial));
    }
    assert_eq!(trial.start(), Ok(StartAction::GoBack));
    // The previous slot runs permanently.
    assert_eq!(trial.start(), Ok(StartAction::Settled));
}

#[test]
fn keeps_a_healthy_firmware() {
    let mut trial = Trial::new(Memory::of(4096), 0);
    trial.begin().unwrap();
    assert_eq!(trial.start(), Ok(StartAction::OnTrial));
    trial.keep().unwrap();
    for _ in 0..5 {
        assert_eq!(trial.start(), Ok(StartAction::Settled));
    }
    // The next update is on trial again.
    trial.begin().unwrap();
    assert_eq!(trial.start(), Ok(StartAction::OnTrial));
}

/// The power may fail within any write of a start: the rollback still happens.
#[test]
fn rolls_back_despite_power_failures() {
    for power in 0..40 {
        let mut trial = Trial::new(Memory::of(4096), 0);
        trial.begin().unwrap();
        trial.flash.power = power;
        let mut verdicts = vec![];
        while let Ok(verdict) = trial.start() {
            verdicts.push(verdict);
            if verdict == StartAction::GoBack {
                break;
            }
        }
        trial.flash.power = usize::MAX;
        let more = (0..=STARTS).find(|_| trial.start() == Ok(StartAction::GoBack));
        assert!(verdicts.contains(&StartAction::GoBack) || more.is_some(), "power {power}");
    }
}
