//! The client's side: it knows a code that somebody read to it.

use hmac::{Hmac, Mac};
use sha2::Sha256;
use vizflyt_protocol::messages::{Name, PairingProof, PairingRequest, PairingShare, bounded};

use super::{Agreement, Binding, Code, PairingRole, Transcript, is, start};

/// A client that has begun and waits for the server's half.
pub struct PairingClient {
    agreement: Agreement,
    binding: Binding,
    name: Name,
    share: PairingShare,
}

/// A client that has shown its proof and waits for the server's.
pub struct Confirming(Hmac<Sha256>);

impl PairingClient {
    /// Begins; returns what to send. A name too long for a message is cut.
    pub fn begin(code: Code, name: &str, binding: Binding) -> (Self, PairingRequest) {
        let (agreement, share) = start(PairingRole::A, code);
        let name: Name = bounded(name);
        let message = PairingRequest::Begin { name: name.clone(), share };
        (Self { agreement, binding, name, share }, message)
    }

    /// Takes the server's half; returns what to send, `None` if it is no half.
    pub fn confirm(self, server_share: &PairingShare) -> Option<(Confirming, PairingRequest)> {
        let transcript = Transcript {
            binding: &self.binding,
            name: &self.name,
            client_share: &self.share,
            server_share,
        };
        let proofs = transcript.prove(PairingRole::A, self.agreement)?;
        let proof = proofs.client.finalize().into_bytes().into();
        Some((Confirming(proofs.server), PairingRequest::Confirm { proof }))
    }
}

impl Confirming {
    /// Whether the server has the key too: then it is the one that showed the code.
    pub fn is_proof(self, proof: &PairingProof) -> bool {
        is(self.0, proof)
    }
}
