//! Limit of simultaneously open pages.

use std::collections::BTreeMap;

use super::access::Viewer;

/// Open pages by kind: pages of teams never take an instructor's place.
#[derive(Debug, Default)]
pub(crate) struct Watchers {
    instructors: usize,
    teams: BTreeMap<String, usize>,
}

impl Watchers {
    /// Takes a place for a viewer.
    ///
    /// # Errors
    /// Reason for which no place is free.
    pub(super) fn enter(&mut self, viewer: &Viewer) -> Result<(), String> {
        match viewer {
            Viewer::Instructor if self.instructors >= MAX_INSTRUCTORS => {
                Err(format!("{MAX_INSTRUCTORS} pages of instructors are open already; close one"))
            }
            Viewer::Instructor => {
                self.instructors += 1;
                Ok(())
            }
            Viewer::Team(vehicle) => {
                let own = self.teams.get(vehicle).copied().unwrap_or_default();
                if own >= MAX_OF_TEAM {
                    return Err(format!(
                        "{MAX_OF_TEAM} pages are open with this team's key already; close one"
                    ));
                }
                if self.teams.values().sum::<usize>() >= MAX_TEAMS {
                    return Err(format!("{MAX_TEAMS} pages of teams are open already; close one"));
                }
                self.teams.insert(vehicle.clone(), own + 1);
                Ok(())
            }
        }
    }

    pub(super) fn leave(&mut self, viewer: &Viewer) {
        match viewer {
            Viewer::Instructor => self.instructors -= 1,
            Viewer::Team(vehicle) => {
                if let Some(own) = self.teams.get_mut(vehicle) {
                    *own -= 1;
                }
                self.teams.retain(|_, own| *own > 0);
            }
        }
    }
}

/// Maximum pages of instructors; each costs about 3 Mbit/s.
const MAX_INSTRUCTORS: usize = 32;
/// Maximum pages with one team's key.
const MAX_OF_TEAM: usize = 16;
/// Maximum pages of all teams.
const MAX_TEAMS: usize = 48;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_team_does_not_take_places_of_instructors_or_other_teams() {
        let mut watchers = Watchers::default();
        let team = |name: &str| Viewer::Team(name.to_owned());
        let ants = (0..64).filter(|_| watchers.enter(&team("ant")).is_ok()).count();
        assert_eq!(ants, MAX_OF_TEAM);
        let full = watchers.enter(&team("ant")).unwrap_err();
        assert!(full.contains("with this team's key already") && full.len() <= 123, "{full}");
        assert_eq!(watchers.enter(&team("bee")), Ok(()));
        assert_eq!(watchers.enter(&Viewer::Instructor), Ok(()));
        watchers.leave(&team("ant"));
        assert_eq!(watchers.enter(&team("ant")), Ok(()));
        for name in 0..100 {
            let _ = watchers.enter(&team(&name.to_string()));
        }
        assert_eq!(watchers.teams.values().sum::<usize>(), MAX_TEAMS);
        let bosses = (0..64).filter(|_| watchers.enter(&Viewer::Instructor).is_ok()).count();
        assert_eq!(1 + bosses, MAX_INSTRUCTORS);
    }
}
