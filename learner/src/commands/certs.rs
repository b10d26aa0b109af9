//! `comic-learner certs`: a certificate authority for development, and certificates of it.

use std::fs::{self, OpenOptions};
use std::io::Write as _;
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

use clap::Args;
use rand::Rng as _;
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose,
};
use time::{Duration, OffsetDateTime};

use crate::error::{Error, Result};

/// Makes an authority and certificates for a learner and its actors, or, where DIR holds an authority, renews the
/// certificates by it: a learner and actors that run take them up by themselves.
#[derive(Clone, Debug, Args)]
#[command(
    after_help = "DIR then holds ca.pem, server.pem and client.pem, each with its -key.pem, readable by their owner alone.\n\
    The authority's key is kept beside them: this is for development, not for an authority that others rely on."
)]
pub struct Certs {
    /// Where they are put.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Names and addresses by which actors reach the learner.
    #[arg(long = "name", value_name = "NAME", num_args = 1.., default_values = ["localhost", "127.0.0.1", "::1"])]
    pub names: Vec<String>,
    /// Days for which the learner's and the actors' certificates hold, from now on.
    #[arg(long, default_value_t = 90, value_parser = clap::value_parser!(u16).range(1..=3650))]
    pub days: u16,
    /// A token for both, too, in DIR/token, unless there is one already.
    #[arg(long)]
    pub token: bool,
    /// Where what the learner needs is put as well, without the authority's key.
    #[arg(long, value_name = "DIR")]
    pub copy_for_learner: Option<PathBuf>,
    /// Where what actors need is put as well, with neither the authority's key nor the learner's.
    #[arg(long, value_name = "DIR")]
    pub copy_for_actors: Option<PathBuf>,
}

/// What actors show and trust. Keys come before certificates: whoever looks in between finds two that do not fit, and keeps
/// what it has.
const ACTORS: [&str; 4] = ["token", "client-key.pem", "client.pem", "ca.pem"];
/// What the learner shows, beside what its own health checks do.
const LEARNER: [&str; 2] = ["server-key.pem", "server.pem"];

/// Days for which an authority holds.
const AUTHORITY_DAYS: i64 = 3650;
/// Clocks may differ by so much.
const SKEW: Duration = Duration::minutes(5);

impl Certs {
    /// Writes the files and names them on stdout.
    ///
    /// # Errors
    /// A name that is none, an authority that cannot be used, a directory that cannot be written.
    pub fn run(&self) -> Result<()> {
        fs::create_dir_all(&self.out).map_err(Error::file("make", &self.out))?;
        let now = OffsetDateTime::now_utc();
        let (from, until) = (now - SKEW, now + Duration::days(self.days.into()));
        let issuer = self.authority(now)?;
        let server = ("server", self.names.clone(), ExtendedKeyUsagePurpose::ServerAuth);
        let client = ("client", vec!["comic-actor".to_owned()], ExtendedKeyUsagePurpose::ClientAuth);
        for (name, subjects, usage) in [server, client] {
            let mut params = CertificateParams::new(subjects)
                .map_err(|error| Error::configuration(format!("--name is no host name and no address: {error}")))?;
            params.distinguished_name.push(DnType::CommonName, format!("CoMic {name}"));
            params.extended_key_usages = vec![usage];
            params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
            (params.not_before, params.not_after) = (from, until);
            let key = KeyPair::generate()?;
            let certificate = params.signed_by(&key, &issuer)?;
            self.write(name, &certificate.pem(), &key)?;
        }
        if self.token && !self.out.join("token").exists() {
            let token: String = hex::encode(rand::rng().random::<[u8; 32]>());
            put(&self.out, "token", 0o600, &format!("{token}\n"))?;
        }
        if let Some(place) = &self.copy_for_learner {
            LEARNER.iter().chain(&ACTORS).try_for_each(|file| self.copy(file, place))?;
        }
        if let Some(place) = &self.copy_for_actors {
            ACTORS.iter().try_for_each(|file| self.copy(file, place))?;
        }
        Ok(())
    }

    fn copy(&self, file: &str, place: &Path) -> Result<()> {
        let from = self.out.join(file);
        if !from.exists() {
            return Ok(());
        }
        let text = fs::read_to_string(&from).map_err(Error::file("read", &from))?;
        // What is the same is left alone: an actor may read it just now.
        if fs::read_to_string(place.join(file)).is_ok_and(|there| there == text) {
            return Ok(());
        }
        fs::create_dir_all(place).map_err(Error::file("make", place))?;
        let mode = fs::metadata(&from).map_err(Error::file("read", &from))?.permissions().mode() & 0o777;
        put(place, file, mode, &text)
    }

    /// The authority in the directory, or a new one.
    fn authority(&self, now: OffsetDateTime) -> Result<Issuer<'static, KeyPair>> {
        let [certificate, key] = ["ca.pem", "ca-key.pem"].map(|name| self.out.join(name));
        if certificate.exists() || key.exists() {
            let read = |path: &Path| {
                let text = fs::read_to_string(path);
                text.map_err(|error| {
                    Error::configuration(format!("half an authority: cannot read {}: {error}", path.display()))
                })
            };
            let (certificate, key) = (read(&certificate)?, read(&key)?);
            let unusable = |error| {
                Error::configuration(format!("the authority in {} cannot be used: {error}", self.out.display()))
            };
            let key = KeyPair::from_pem(&key).map_err(unusable)?;
            return Issuer::from_ca_cert_pem(&certificate, key).map_err(unusable);
        }
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, "CoMic development authority");
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        (params.not_before, params.not_after) = (now - SKEW, now + Duration::days(AUTHORITY_DAYS));
        let key = KeyPair::generate()?;
        self.write("ca", &params.self_signed(&key)?.pem(), &key)?;
        Ok(Issuer::new(params, key))
    }

    fn write(&self, name: &str, certificate: &str, key: &KeyPair) -> Result<()> {
        // The key first: a learner that looks in between finds two that do not fit, and keeps what it has.
        put(&self.out, &format!("{name}-key.pem"), 0o600, &key.serialize_pem())?;
        put(&self.out, &format!("{name}.pem"), 0o644, certificate)?;
        // Nobody has to read it.
        let _ = writeln!(std::io::stdout(), "{}", self.out.join(format!("{name}.pem")).display());
        Ok(())
    }
}

fn put(directory: &Path, file: &str, mode: u32, text: &str) -> Result<()> {
    let path = directory.join(file);
    let mut open = OpenOptions::new();
    let file = open.create(true).write(true).truncate(true).mode(mode).open(&path);
    let mut file = file.map_err(Error::file("write", &path))?;
    // A file that was there keeps its own mode.
    let written = file.set_permissions(fs::Permissions::from_mode(mode)).and_then(|()| file.write_all(text.as_bytes()));
    written.map_err(Error::file("write", &path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::security::Tls;

    fn certs(out: &Path) -> Certs {
        let names = vec!["localhost".into()];
        Certs { out: out.into(), names, days: 1, token: true, copy_for_learner: None, copy_for_actors: None }
    }

    #[test]
    fn each_side_gets_what_it_needs_and_nobody_the_authoritys_key() {
        let directory = tempfile::tempdir().unwrap();
        let place = |name: &str| directory.path().join(name);
        let apart = Certs {
            copy_for_learner: Some(place("learner")),
            copy_for_actors: Some(place("actors")),
            ..certs(&place("authority"))
        };
        apart.run().unwrap();
        let file = |name: &str| place("learner").join(name);
        Tls::new(&file("server.pem"), &file("server-key.pem"), Some(&file("ca.pem"))).unwrap();
        let names = |of: &str| {
            let names = fs::read_dir(place(of)).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
            names.collect::<std::collections::BTreeSet<_>>()
        };
        let actors = ["ca.pem", "client-key.pem", "client.pem", "token"].map(String::from);
        assert!(names("actors").iter().eq(&actors), "{:?}", names("actors"));
        assert!(!names("learner").contains("ca-key.pem"));
        assert_eq!(fs::metadata(place("actors").join("client-key.pem")).unwrap().permissions().mode() & 0o777, 0o600);
    }

    /// An actor may read them just now.
    #[test]
    fn copies_of_what_did_not_change_are_left_alone() {
        let directory = tempfile::tempdir().unwrap();
        let place = directory.path().join("actors");
        let apart = Certs { copy_for_actors: Some(place.clone()), ..certs(&directory.path().join("authority")) };
        apart.run().unwrap();
        let long_ago = std::time::SystemTime::UNIX_EPOCH;
        let written = |name: &str| fs::metadata(place.join(name)).unwrap().modified().unwrap() != long_ago;
        for name in ACTORS {
            fs::File::options().write(true).open(place.join(name)).unwrap().set_modified(long_ago).unwrap();
        }
        apart.run().unwrap();
        assert_eq!(ACTORS.map(written), ACTORS.map(|name| name.starts_with("client")), "{ACTORS:?}");
    }

    #[test]
    fn what_is_made_can_be_served_and_the_keys_are_their_owners() {
        let directory = tempfile::tempdir().unwrap();
        certs(directory.path()).run().unwrap();
        let file = |name: &str| directory.path().join(name);
        Tls::new(&file("server.pem"), &file("server-key.pem"), Some(&file("ca.pem"))).unwrap();
        assert!(Tls::new(&file("server.pem"), &file("client-key.pem"), None).is_err(), "another's key");
        for key in ["ca-key.pem", "server-key.pem", "client-key.pem", "token"] {
            assert_eq!(fs::metadata(file(key)).unwrap().permissions().mode() & 0o777, 0o600, "{key}");
        }
    }

    #[test]
    fn a_second_time_the_certificates_are_renewed_by_the_same_authority() {
        let directory = tempfile::tempdir().unwrap();
        let read = |name: &str| fs::read_to_string(directory.path().join(name)).unwrap();
        certs(directory.path()).run().unwrap();
        let (authority, server, token) = (read("ca.pem"), read("server.pem"), read("token"));
        assert_eq!(token.trim().len(), 64);
        certs(directory.path()).run().unwrap();
        assert_eq!((read("ca.pem"), read("token")), (authority, token));
        assert_ne!(read("server.pem"), server);
        fs::remove_file(directory.path().join("ca-key.pem")).unwrap();
        assert_eq!(certs(directory.path()).run().unwrap_err().exit_code(), 2);
    }
}
