//! Shell completions and man pages of a program, made from its own command line.

use std::fs;
use std::io;
use std::path::PathBuf;

use clap::{Args, Command};
use clap_complete::Shell;

/// Write shell completions and man pages
#[derive(Clone, Debug, Args)]
pub struct Manual {
    /// Directory such as /usr/share or ~/.local/share, in whose subdirectories bash, zsh, fish and man find them
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// Where each shell looks for completions below /usr/share, and the name of the file for the program `{}`.
const COMPLETIONS: [(Shell, &str, &str); 3] = [
    (Shell::Bash, "bash-completion/completions", "{}"),
    (Shell::Zsh, "zsh/vendor-completions", "_{}"),
    (Shell::Fish, "fish/vendor_completions.d", "{}.fish"),
];

impl Manual {
    /// Writes the completions and pages of `command`.
    ///
    /// # Errors
    /// A directory that cannot be written.
    pub fn write(&self, mut command: Command) -> io::Result<()> {
        let program = command.get_name().to_owned();
        // Before `generate`, which adds the subcommand `help`.
        let pages = without_help(command.clone());
        for (shell, directory, name) in COMPLETIONS {
            let directory = self.directory(directory)?;
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut command, &program, &mut script);
            fs::write(directory.join(name.replace("{}", &program)), script)?;
        }
        clap_mangen::generate_to(pages, self.directory("man/man1")?)
    }

    /// The directory `path` below `out`, which is made if it does not exist.
    fn directory(&self, path: &str) -> io::Result<PathBuf> {
        let directory = self.out.join(path);
        fs::create_dir_all(&directory)?;
        Ok(directory)
    }
}

/// `command` without the subcommand `help`, which would have a page for every other page.
fn without_help(command: Command) -> Command {
    command.disable_help_subcommand(true).mut_subcommands(without_help)
}

#[cfg(test)]
mod tests {
    use clap::Arg;

    use super::*;

    #[test]
    fn every_shell_and_every_subcommand_has_its_file() {
        let directory = tempfile::tempdir().unwrap();
        let certs = Command::new("certs").about("Make certificates");
        let command =
            Command::new("comic-learner").arg(Arg::new("port").long("port").help("The port")).subcommand(certs);
        Manual { out: directory.path().into() }.write(command).unwrap();
        for (file, text) in [
            ("bash-completion/completions/comic-learner", "--port"),
            ("zsh/vendor-completions/_comic-learner", "--port"),
            ("fish/vendor_completions.d/comic-learner.fish", "-l port"),
            ("man/man1/comic-learner.1", "The port"),
            ("man/man1/comic-learner-certs.1", "Make certificates"),
        ] {
            let written = fs::read_to_string(directory.path().join(file)).unwrap();
            assert!(written.contains(text), "{file} has no {text}");
        }
        let pages = fs::read_dir(directory.path().join("man/man1")).unwrap().count();
        assert_eq!(pages, 2, "the subcommand `help` has no page");
    }
}
