//! `comic-learner certs`: a certificate authority for development, and its certificates.

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

/// Makes an authority and certificates for a learner and its actors. If DIR already holds an authority, the certificates are
/// renewed with it; a running learner and running actors use the new ones without a restart.
#[derive(Clone, Debug, Args)]
#[command(
    after_help = "DIR then holds ca.pem, server.pem and client.pem, each with its -key.pem, readable only by their owner.\n\
    The authority's key is in the same directory: use it for development only."
)]
pub struct Certs {
    /// Directory of the authority and the certificates.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Names and addresses under which actors reach the learner.
    #[arg(long = "name", value_name = "NAME", num_args = 1.., default_values = ["localhost", "127.0.0.1", "::1"])]
    pub names: Vec<String>,
    /// Days for which the certificates of the learner and the actors are valid.
    #[arg(long, default_value_t = 90, value_parser = clap::value_parser!(u16).range(1..=3650))]
    pub days: u16,
    /// Also make a token for both, in DIR/token, unless it exists.
    #[arg(long)]
    pub token: bool,
    /// Copy the files that the learner needs to this directory, without the authority's key.
    #[arg(long, value_name = "DIR")]
    pub copy_for_learner: Option<PathBuf>,
    /// Copy the files that actors need to this directory, without the keys of the authority and the learner.
    #[arg(long, value_name = "DIR")]
    pub copy_for_actors: Option<PathBuf>,
}

/// Files of actors. Keys come before certificates: a program that reads the files in between finds a key and a certificate
/// that do not fit, and keeps the ones that it has.
const ACTOR_FILES: [&str; 4] = ["token", "client-key.pem", "client.pem", "ca.pem"];
/// Files of the learner; its health checks also need those of actors.
const LEARNER_FILES: [&str; 2] = ["server-key.pem", "server.pem"];

/// Days for which an authority is valid.
const AUTHORITY_DAYS: i64 = 3650;
/// The difference that clocks may have.
const SKEW: Duration = Duration::minutes(5);

impl Certs {
    /// Writes the files and names them on stdout.
    ///
    /// # Errors
    /// An invalid name, an authority that cannot be used, a directory that cannot be written.
    pub fn run(&self) -> Result<()> {
        fs::create_dir_all(&self.out).map_err(Error::file("make", &self.out))?;
        let now = OffsetDateTime::now_utc();
        let (from, until) = (now - SKEW, now + Duration::days(self.days.into()));
        let issuer = self.authority(now)?;
        let server = ("server", self.names.clone(), ExtendedKeyUsagePurpose::ServerAuth);
        let client = ("client", vec!["comic-actor".to_owned()], ExtendedKeyUsagePurpose::ClientAuth);
        for (name, subjects, usage) in [server, client] {
            let mut params = CertificateParams::new(subjects).map_err(|error| {
                Error::configuration(format!("--name is neither a host name nor an address: {error}"))
            })?;
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
        if let Some(directory) = &self.copy_for_learner {
            LEARNER_FILES.iter().chain(&ACTOR_FILES).try_for_each(|file| self.copy(file, directory))?;
        }
        if let Some(directory) = &self.copy_for_actors {
            ACTOR_FILES.iter().try_for_each(|file| self.copy(file, directory))?;
        }
        Ok(())
    }

    fn copy(&self, file: &str, place: &Path) -> Result<()> {
        let from = self.out.join(file);
        if !from.exists() {
            return Ok(());
        }
        let text = fs::read_to_string(&from).map_err(Error::file("read", &from))?;
        // A file with the same contents is not written, because an actor may be reading it.
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
                    Error::configuration(format!(
                        "the authority is incomplete: cannot read {}: {error}",
                        path.display()
                    ))
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
        // The key first, as in `ACTOR_FILES`.
        put(&self.out, &format!("{name}-key.pem"), 0o600, &key.serialize_pem())?;
        put(&self.out, &format!("{name}.pem"), 0o644, certificate)?;
        // An error is not important: stdout may be closed.
        let _ = writeln!(std::io::stdout(), "{}", self.out.join(format!("{name}.pem")).display());
        Ok(())
    }
}

/// Writes a file with this mode.
fn put(directory: &Path, file: &str, mode: u32, text: &str) -> Result<()> {
    let path = directory.join(file);
    let mut open = OpenOptions::new();
    let file = open.create(true).write(true).truncate(true).mode(mode).open(&path);
    let mut file = file.map_err(Error::file("write", &path))?;
    // An existing file would keep its own mode.
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
    fn each_side_gets_the_files_that_it_needs_and_no_side_the_authoritys_key() {
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

    /// Because an actor may be reading them.
    #[test]
    fn unchanged_copies_are_not_written() {
        let directory = tempfile::tempdir().unwrap();
        let place = directory.path().join("actors");
        let apart = Certs { copy_for_actors: Some(place.clone()), ..certs(&directory.path().join("authority")) };
        apart.run().unwrap();
        let long_ago = std::time::SystemTime::UNIX_EPOCH;
        let written = |name: &str| fs::metadata(place.join(name)).unwrap().modified().unwrap() != long_ago;
        for name in ACTOR_FILES {
            fs::File::options().write(true).open(place.join(name)).unwrap().set_modified(long_ago).unwrap();
        }
        apart.run().unwrap();
        assert_eq!(ACTOR_FILES.map(written), ACTOR_FILES.map(|name| name.starts_with("client")), "{ACTOR_FILES:?}");
    }

    #[test]
    fn the_certificates_can_be_served_and_only_the_owner_can_read_the_keys() {
        let directory = tempfile::tempdir().unwrap();
        certs(directory.path()).run().unwrap();
        let file = |name: &str| directory.path().join(name);
        Tls::new(&file("server.pem"), &file("server-key.pem"), Some(&file("ca.pem"))).unwrap();
        assert!(
            Tls::new(&file("server.pem"), &file("client-key.pem"), None).is_err(),
            "the key of another certificate"
        );
        for key in ["ca-key.pem", "server-key.pem", "client-key.pem", "token"] {
            assert_eq!(fs::metadata(file(key)).unwrap().permissions().mode() & 0o777, 0o600, "{key}");
        }
    }

    #[test]
    fn a_second_run_renews_the_certificates_with_the_same_authority() {
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
