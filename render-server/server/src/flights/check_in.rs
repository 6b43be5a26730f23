//! Check-in of teams at a vehicle, and permission to change it. Pure.
//!
//! A token states for which team a flight counts. The team checks in at its vehicle: on a page with that
//! vehicle's right, or at the computer that flies it. The check-in stays until a flight has landed, unless the
//! same team, the vehicle's computer or the instructor changes it.

use std::net::IpAddr;

use vizflyt_protocol::time::ServerTime;

use super::leaderboard::Attempt;
use super::vehicle::Flight;

/// Check-in of a team.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckIn {
    pub team: String,
    /// Type of its flights.
    pub attempt: Attempt,
    /// Time of the check-in.
    pub at: ServerTime,
    /// Computer of the check-in; `None` if the instructor has set it.
    pub from: Option<IpAddr>,
}

/// Request to change a check-in.
#[derive(Clone, Copy, Debug)]
pub struct Claim<'a> {
    /// Team of the token.
    pub team: Option<&'a str>,
    /// Address of the sender.
    pub from: IpAddr,
    /// The request has the instructor's right.
    pub is_instructor: bool,
    /// The request has the right to this vehicle's page.
    pub has_vehicle: bool,
}

/// Why a check-in cannot be changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CheckInRefusal {
    /// The request comes neither with the vehicle's key nor from its computer.
    #[error(
        "a team checks in at its vehicle: on a page with that vehicle's key, or at the computer that flies it"
    )]
    Elsewhere,
    /// Another team is checked in.
    #[error(
        "{0} is checked in and has not flown yet; {0} itself, the vehicle's computer or the instructor can change that"
    )]
    Taken(String),
}

/// Checks whether a claim may replace or remove the present check-in. `runtime` is the address of the vehicle's
/// runtime.
///
/// # Errors
/// Why it may not.
pub fn judge(
    present: Option<&CheckIn>,
    claim: Claim<'_>,
    flight: &Flight,
    runtime: Option<IpAddr>,
) -> Result<(), CheckInRefusal> {
    let is_at = |other: IpAddr| other.to_canonical() == claim.from.to_canonical();
    let is_at_vehicle = runtime.is_some_and(is_at);
    if claim.is_instructor || is_at_vehicle {
        return Ok(());
    }
    if !claim.has_vehicle {
        return Err(CheckInRefusal::Elsewhere);
    }
    let Some(present) = present else { return Ok(()) };
    let has_flown = flight.landed.is_some_and(|landed| landed > present.at);
    let is_own = claim.team == Some(present.team.as_str()) || present.from.is_some_and(is_at);
    if has_flown || is_own { Ok(()) } else { Err(CheckInRefusal::Taken(present.team.clone())) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 1));
    const B: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 2));
    const JETSON: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 3));

    fn ants() -> CheckIn {
        CheckIn {
            team: "ants".to_owned(),
            attempt: Attempt::Official,
            at: ServerTime::from_ns(1_000),
            from: Some(A),
        }
    }

    fn claim(team: Option<&str>, from: IpAddr) -> Claim<'_> {
        Claim { team, from, is_instructor: false, has_vehicle: true }
    }

    fn check(claim: Claim<'_>, flight: &Flight, expected: bool) {
        let found = judge(Some(&ants()), claim, flight, Some(JETSON));
        assert_eq!(found.is_ok(), expected, "{claim:?}: {found:?}");
    }

    #[test]
    fn check_in_is_protected_from_other_teams_until_its_flight() {
        let waiting = Flight::default();
        check(claim(Some("bees"), B), &waiting, false);
        check(claim(None, B), &waiting, false);
        check(claim(Some("ants"), B), &waiting, true);
        check(claim(None, A), &waiting, true);
        check(claim(Some("bees"), JETSON), &waiting, true);
        check(Claim { is_instructor: true, ..claim(Some("bees"), B) }, &waiting, true);
        let flying = Flight { took_off: Some(ServerTime::from_ns(2_000)), ..Flight::default() };
        check(claim(Some("bees"), B), &flying, false);
        let landed = Flight { landed: Some(ServerTime::from_ns(3_000)), ..flying };
        check(claim(Some("bees"), B), &landed, true);
        // Landing of the previous team, before this check-in.
        let before = Flight { landed: Some(ServerTime::from_ns(500)), ..Flight::default() };
        check(claim(Some("bees"), B), &before, false);
    }

    #[test]
    fn a_token_without_a_vehicle_right_is_rejected() {
        let stranger = Claim { has_vehicle: false, ..claim(Some("bees"), B) };
        let elsewhere = Err(CheckInRefusal::Elsewhere);
        assert_eq!(judge(None, stranger, &Flight::default(), Some(JETSON)), elsewhere);
        assert_eq!(judge(None, stranger, &Flight::default(), None), elsewhere);
        assert_eq!(judge(None, stranger, &Flight::default(), Some(B)), Ok(()));
        assert_eq!(judge(None, claim(Some("bees"), B), &Flight::default(), None), Ok(()));
    }
}
