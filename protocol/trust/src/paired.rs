//! `paired.toml`: clients that are paired with the server, and their rights.
//!
//! The file is written by pairing, may be edited by hand, and is read again after each change.

use serde::{Deserialize, Serialize};

use crate::Fingerprint;
use crate::folder::{KeyError, KeysFolder};

/// Rights of a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// May fly and watch its own vehicles.
    Team,
    /// May do everything.
    Instructor,
}

/// Paired client.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Client {
    /// Name for display.
    pub name: String,
    /// Fingerprint of its certificate.
    pub fingerprint: Fingerprint,
    /// Rights of the client.
    pub role: Role,
    /// Vehicles of a team. An instructor may use all vehicles.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub vehicles: Vec<String>,
}

impl Client {
    /// Whether this client may fly and watch a vehicle.
    pub fn may_use(&self, vehicle: &str) -> bool {
        match self.role {
            Role::Instructor => true,
            Role::Team => self.vehicles.iter().any(|own| own == vehicle),
        }
    }
}

/// All paired clients.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Paired {
    /// Clients in the order of the file.
    #[serde(default, rename = "client")]
    pub clients: Vec<Client>,
}

impl Paired {
    /// Name of the file in the keys folder.
    pub const FILE: &str = "paired.toml";

    /// Parses and checks the text of the file.
    ///
    /// # Errors
    /// Returns a sentence with the position and the error.
    pub fn parse(text: &str) -> Result<Self, String> {
        let paired: Self = toml::from_str(text).map_err(|error| error.to_string())?;
        for (index, client) in paired.clients.iter().enumerate() {
            let name = &client.name;
            let fail = |what: &str| Err(format!("client '{name}': {what}"));
            if !is_name(name) {
                return fail("a name is 1 to 32 bytes of text without control characters");
            }
            match client.role {
                Role::Team if client.vehicles.is_empty() => {
                    return fail("a team needs vehicles = [\"NAME\", ...]");
                }
                Role::Instructor if !client.vehicles.is_empty() => {
                    return fail("an instructor has every vehicle; remove vehicles");
                }
                _ => {}
            }
            if let Some(wrong) = client.vehicles.iter().find(|vehicle| !is_name(vehicle)) {
                return fail(&format!(
                    "'{wrong}' is not a valid name of a vehicle (1 to 32 bytes of text)"
                ));
            }
            let same = |other: &Client| other.fingerprint == client.fingerprint;
            if paired.clients[..index].iter().any(same) {
                return fail("its fingerprint occurs twice; keep one of the two entries");
            }
        }
        Ok(paired)
    }

    /// Reads the file of a keys folder. Without a file, no client is paired.
    pub fn read(folder: &KeysFolder) -> Result<Self, KeyError> {
        let text = folder.read(Self::FILE)?.unwrap_or_default();
        Self::parse(&text).map_err(|what| KeyError::Damaged { path: folder.file(Self::FILE), what })
    }

    /// Adds a client to the file, and replaces an entry with the same fingerprint.
    ///
    /// New entries are appended, so that comments of the user are kept.
    pub fn add(folder: &KeysFolder, client: Client) -> Result<Self, KeyError> {
        let damaged = |what| KeyError::Damaged { path: folder.file(Self::FILE), what };
        let mut paired = Self::read(folder)?;
        let known = paired.clients.iter_mut().find(|c| c.fingerprint == client.fingerprint);
        let text = if let Some(known) = known {
            *known = client;
            HEAD.to_owned() + &toml::to_string(&paired).map_err(|e| damaged(e.to_string()))?
        } else {
            let one = Self { clients: vec![client] };
            let one = toml::to_string(&one).map_err(|e| damaged(e.to_string()))?;
            let before = folder.read(Self::FILE)?.unwrap_or_else(|| HEAD.to_owned());
            format!("{}\n\n{one}", before.trim_end())
        };
        let paired = Self::parse(&text).map_err(damaged)?;
        folder.write(Self::FILE, &text)?;
        Ok(paired)
    }

    /// Returns the client with this fingerprint.
    pub fn client(&self, fingerprint: Fingerprint) -> Option<&Client> {
        self.clients.iter().find(|client| client.fingerprint == fingerprint)
    }
}

/// Whether `text` is a valid name of a vehicle or client: it must fit in a message and in one line of a log.
pub(crate) fn is_name(text: &str) -> bool {
    (1..=32).contains(&text.len()) && !text.chars().any(char::is_control)
}

const HEAD: &str = "\
# Clients that may connect to this server, and their rights. `vizflyt pair` adds an entry. Removing one ends that
# client's rights and its connection at once. A team may use its own vehicles, an instructor everything.
";

#[cfg(test)]
mod tests {
    use super::*;

    fn client(name: &str, role: Role, vehicles: &[&str]) -> Client {
        Client {
            name: name.to_owned(),
            fingerprint: Fingerprint::of(name.as_bytes()),
            role,
            vehicles: vehicles.iter().map(ToString::to_string).collect(),
        }
    }

    fn check_refused(text: &str, expected: &str) {
        let error = Paired::parse(text).unwrap_err();
        assert!(error.contains(expected), "{text}: {error}");
    }

    #[test]
    fn a_team_may_use_its_own_vehicles_and_an_instructor_all() {
        let team = client("ants", Role::Team, &["ant", "bee"]);
        assert!(team.may_use("ant") && team.may_use("bee"));
        assert!(!team.may_use("wasp") && !team.may_use("") && !team.may_use("Ant"));
        assert!(client("boss", Role::Instructor, &[]).may_use("wasp"));
    }

    #[test]
    fn appends_replaces_and_reads_entries() {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        assert_eq!(Paired::read(&folder).unwrap(), Paired::default());
        Paired::add(&folder, client("ants", Role::Team, &["ant"])).unwrap();
        let text = folder.read(Paired::FILE).unwrap().unwrap() + "# of the lab\n";
        folder.write(Paired::FILE, &text).unwrap();
        Paired::add(&folder, client("boss", Role::Instructor, &[])).unwrap();
        assert!(folder.read(Paired::FILE).unwrap().unwrap().contains("# of the lab"));
        let mut again = client("ants", Role::Team, &["bee"]);
        again.name = "bees".to_owned();
        Paired::add(&folder, again.clone()).unwrap();
        let paired = Paired::read(&folder).unwrap();
        assert_eq!(paired.clients, [again, client("boss", Role::Instructor, &[])]);
        assert!(paired.client(Fingerprint::of(b"ants")).is_some());
        assert!(paired.client(Fingerprint::of(b"wasp")).is_none());
    }

    #[test]
    fn reports_errors_of_manual_edits() {
        let print = Fingerprint::of(b"x");
        let entry =
            |more: &str| format!("[[client]]\nname = \"a\"\nfingerprint = \"{print}\"\n{more}\n");
        Paired::parse(&entry("role = \"instructor\"")).unwrap();
        check_refused(&entry("role = \"team\""), "client 'a': a team needs vehicles");
        check_refused(&entry("role = \"boss\""), "line 4");
        check_refused(&entry("role = \"instructor\"\nvehicles = [\"x\"]"), "remove vehicles");
        check_refused(&entry("role = \"instructor\"\nvehicle = \"x\""), "unknown field");
        check_refused(
            &entry("role = \"team\"\nvehicles = [\"\"]"),
            "not a valid name of a vehicle",
        );
        let twice = entry("role = \"instructor\"").repeat(2);
        check_refused(&twice, "occurs twice");
        check_refused(&twice.replace(&print.to_string(), "12"), "64 hex digits");
        check_refused("[[clients]]", "unknown field");
    }
}
