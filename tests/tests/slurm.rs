//! The batch file for Slurm with the real programs. Stand-ins for Slurm's commands run every task on this machine.

use std::env;
use std::fs::{self, File};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use comic_tests::repository::root;
use comic_tests::steps::{LIMIT, checkpoint_in};
use comic_tests::system::{SMALL, program};
use rustix::process::{Pid, Signal, kill_process, kill_process_group};
use serde_json::Value;
use tempfile::TempDir;

/// Like Slurm's, it ends with the highest exit code of its tasks, and kills them when it gets SIGTERM.
const SRUN: &str = r#"#!/bin/bash
echo "srun $*" >> "$STAND_INS/commands"
tasks=1
while [[ $1 == --* ]]; do
  [[ $1 == --ntasks=* ]] && tasks=${1#*=}
  shift
done
for ((task = 0; task < tasks; task++)); do
  "$@" &
  pids+=($!)
done
echo "${pids[@]}" >> "$STAND_INS/tasks"
trap 'kill -KILL "${pids[@]}"' TERM
code=0
for pid in "${pids[@]}"; do
  wait "$pid" || { ended=$?; code=$((ended > code ? ended : code)); }
done
exit "$code"
"#;
/// The first node is this machine, the second does not exist.
const SCONTROL: &str = r#"#!/bin/bash
echo "scontrol $*" >> "$STAND_INS/commands"
[[ $1 != show ]] || printf '127.0.0.1\nno-such-node\n'
"#;
/// Signals all tasks.
const SCANCEL: &str = r#"#!/bin/bash
echo "scancel $*" >> "$STAND_INS/commands"
[[ $1 == --signal=TERM ]] && kill -TERM $(< "$STAND_INS/tasks")
"#;
/// Makes a minute of the batch file short.
const SLEEP: &str = "#!/bin/bash\nexec /bin/sleep 0.05\n";
const POLL: Duration = Duration::from_millis(50);

/// A directory with the stand-ins, in which one job is started once or several times.
struct Slurm {
    directory: TempDir,
    number: u16,
}

impl Slurm {
    /// The number of the job is the first one from `least` on whose port is free.
    fn new(least: u16) -> Result<Self> {
        let is_free = |number: &u16| TcpListener::bind(("0.0.0.0", 20_000 + number)).is_ok();
        let number = (least..least + 100).find(is_free).context("no port is free")?;
        let slurm = Self { directory: tempfile::tempdir()?, number };
        for (name, script) in [("srun", SRUN), ("scontrol", SCONTROL), ("scancel", SCANCEL)] {
            slurm.stand_in(name, script)?;
        }
        Ok(slurm)
    }

    /// Puts a script in the place of a program.
    fn stand_in(&self, name: &str, script: &str) -> Result<()> {
        let bin = self.directory.path().join("bin");
        fs::create_dir_all(&bin)?;
        fs::write(bin.join(name), script)?;
        fs::set_permissions(bin.join(name), fs::Permissions::from_mode(0o755))?;
        Ok(())
    }

    /// Starts the batch file with three tasks on two nodes. The learner has a small experiment and these options.
    fn start(&self, options: &[&str]) -> Result<Job> {
        let directory = self.directory.path();
        // The tasks of an earlier start have ended.
        let _ = fs::remove_file(directory.join("tasks"));
        let log = directory.join("slurm.out");
        let output = File::create(&log)?;
        let (learner, actor) = (program("comic-learner")?, program("comic-actor")?);
        let programs = [&learner, &actor].into_iter().filter_map(|path| path.parent()).map(Path::to_path_buf);
        let others = env::var_os("PATH").unwrap_or_default();
        let path = [directory.join("bin")].into_iter().chain(programs).chain(env::split_paths(&others));
        let mut command = Command::new("bash");
        command.arg(root().join("deploy/slurm/comic.sbatch")).args(SMALL).args(options).current_dir(directory);
        // The user's directories and settings must not change the result of a test.
        let settings = env::vars_os().map(|(name, _)| name.to_string_lossy().into_owned());
        for name in settings.filter(|name| name.starts_with("COMIC_") || name.starts_with("SLURM_")) {
            command.env_remove(name);
        }
        command.env("HOME", directory).env("XDG_CACHE_HOME", directory.join("cache")).env("NO_COLOR", "1");
        command.env_remove("RUST_LOG").env("PATH", env::join_paths(path)?).env("STAND_INS", directory);
        command.env("SLURM_JOB_ID", self.number.to_string()).env("SLURM_JOB_NODELIST", "node[1-2]");
        command.env("SLURM_NTASKS", "3").env("SLURM_CPUS_PER_TASK", "1");
        command.stdin(Stdio::null()).stdout(output.try_clone()?).stderr(output).process_group(0);
        Ok(Job { script: command.spawn().context("cannot start bash")?, log })
    }

    /// The run's directory, if the user names no other.
    fn run(&self) -> PathBuf {
        self.directory.path().join(format!("runs/slurm-{}", self.number))
    }

    /// The commands that the batch file gave to Slurm, one a line.
    fn commands(&self) -> Result<String> {
        Ok(fs::read_to_string(self.directory.path().join("commands"))?)
    }
}

/// The running batch file. Dropping it kills all tasks, as Slurm does at the end of the batch file.
struct Job {
    script: Child,
    log: PathBuf,
}

impl Job {
    fn log(&self) -> String {
        fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// Waits until the batch file ends.
    fn ends(&mut self) -> Result<ExitStatus> {
        let deadline = Instant::now() + LIMIT;
        while Instant::now() < deadline {
            if let Some(status) = self.script.try_wait()? {
                return Ok(status);
            }
            sleep(POLL);
        }
        bail!("the batch file still runs: {}", self.log())
    }
}

impl Drop for Job {
    fn drop(&mut self) {
        let _ = kill_process_group(Pid::from_child(&self.script), Signal::KILL);
        let _ = self.script.wait();
    }
}

/// The updates of the newest line of metrics.
fn updates(run: &Path) -> u64 {
    let metrics = fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default();
    let lines = metrics.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    lines.filter_map(|line| line["updates"].as_u64()).max().unwrap_or_default()
}

#[test]
fn a_job_is_one_learner_and_its_actors_until_the_run_is_over() -> Result<()> {
    let slurm = Slurm::new(9000)?;
    let mut job = slurm.start(&["--set", "budget.updates=20"])?;
    let status = job.ends()?;
    ensure!(status.success(), "{status}: {}", job.log());
    let commands = slurm.commands()?;
    let step = |program: &str| commands.lines().find(|line| line.contains(program)).context("no such step");
    let (learner, actors) = (step(" comic-learner ")?, step(" comic-actor ")?);
    ensure!(learner.contains(" --ntasks=1 ") && learner.contains(" --nodelist=127.0.0.1 "), "{learner}");
    ensure!(actors.contains(" --ntasks=2 "), "{actors}");
    ensure!(!commands.contains("requeue") && !commands.contains("scancel"), "{commands}");
    let mode = fs::metadata(slurm.run().join("token"))?.permissions().mode();
    ensure!(mode & 0o777 == 0o600, "others can read the token: {mode:o}");
    Ok(())
}

#[test]
fn before_its_time_is_over_a_job_writes_a_checkpoint_and_is_requeued() -> Result<()> {
    let slurm = Slurm::new(9100)?;
    let run = slurm.run();
    let mut job = slurm.start(&["--set", "learner.checkpoint_seconds=3600"])?;
    let deadline = Instant::now() + LIMIT;
    while updates(&run) == 0 {
        ensure!(job.script.try_wait()?.is_none() && Instant::now() < deadline, "no update: {}", job.log());
        sleep(POLL);
    }
    ensure!(checkpoint_in(&run).is_none(), "the checkpoint below would prove nothing");
    // Slurm signals only the batch file.
    kill_process(Pid::from_child(&job.script), Signal::TERM)?;
    let status = job.ends()?;
    ensure!(status.code() == Some(4), "{status}: {}", job.log());
    let kept = checkpoint_in(&run).with_context(|| format!("no checkpoint: {}", job.log()))?;
    let commands = slurm.commands()?;
    ensure!(commands.matches("scancel --signal=TERM").count() == 1, "{commands}");
    ensure!(commands.contains(&format!("scontrol requeue {}\n", slurm.number)), "{commands}");
    drop(job);

    let mut requeued = slurm.start(&["--set", &format!("budget.updates={}", kept + 5)])?;
    let status = requeued.ends()?;
    ensure!(status.success(), "{status}: {}", requeued.log());
    ensure!(requeued.log().contains("learner_epoch=2"), "the run was not resumed: {}", requeued.log());
    Ok(())
}

#[test]
fn a_learner_that_cannot_start_ends_the_job_with_its_code() -> Result<()> {
    let slurm = Slurm::new(9200)?;
    let mut job = slurm.start(&["--set", "no.such.field=1"])?;
    let status = job.ends()?;
    ensure!(status.code() == Some(2), "{status}: {}", job.log());
    ensure!(!slurm.commands()?.contains("requeue"), "it would fail again: {}", slurm.commands()?);
    Ok(())
}

#[test]
fn a_job_whose_actors_all_fail_ends_with_their_code() -> Result<()> {
    let slurm = Slurm::new(9300)?;
    slurm.stand_in("comic-actor", "#!/bin/bash\nexit 2\n")?;
    slurm.stand_in("sleep", SLEEP)?;
    let mut job = slurm.start(&[])?;
    let status = job.ends()?;
    ensure!(status.code() == Some(2), "{status}: {}", job.log());
    let commands = slurm.commands()?;
    ensure!(commands.contains("scancel --signal=TERM"), "the learner waits for actors: {commands}");
    ensure!(!commands.contains("requeue"), "it would fail again: {commands}");
    Ok(())
}
