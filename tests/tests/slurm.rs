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

/// Like Slurm's, it gives a step cores of the job's nodes, one a task; `free` has a file for each free core. Without `--nodes` it
/// needs a core of each node. If there are too few it waits for ever, or with `--immediate` for no time. It ends with the highest exit
/// code of its tasks, and kills them when it gets SIGTERM.
const SRUN: &str = r#"#!/bin/bash
shopt -s nullglob
echo "srun $*" >> "$STAND_INS/commands"
tasks=1 nodes=$SLURM_JOB_NUM_NODES candidates= immediate=
while [[ $1 == --* ]]; do
  case $1 in
    --ntasks=*) tasks=${1#*=} ;;
    --nodes=*) nodes=${1#*=} ;;
    --nodelist=127.0.0.1) candidates=1 ;;
    --immediate=*) immediate=${1#*=} ;;
  esac
  shift
done
((tasks > 0)) || exit 1
least=${nodes%-*} most=${nodes#*-}
((least <= tasks)) || least=$tasks
# The learner's step is slow here, so another step that does not wait for it takes its cores.
if [[ $candidates ]]; then /bin/sleep 1; else candidates=$(seq "$SLURM_JOB_NUM_NODES"); fi

place() {
  local node count=0 cores=() chosen=()
  for node in $candidates; do
    cores=("$STAND_INS/free/$node."*)
    if ((${#cores[@]} > 0 && count < most)); then
      chosen+=("${cores[@]}")
      ((++count))
    fi
  done
  ((count >= least && ${#chosen[@]} >= tasks)) || return
  taken=("${chosen[@]:0:tasks}")
  rm "${taken[@]}"
}
if ! place; then
  [[ $immediate ]] || exec /bin/sleep infinity
  echo "srun: error: Unable to create step for job $SLURM_JOB_ID: Requested nodes are busy" >&2
  exit 1
fi

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
touch "${taken[@]}"
exit "$code"
"#;
/// The first node is this machine, the second does not exist.
const SCONTROL: &str = r#"#!/bin/bash
echo "scontrol $*" >> "$STAND_INS/commands"
[[ $1 != show ]] || printf '127.0.0.1\nno-such-node\n'
"#;
/// Signals all tasks of a job, unless it is cancelled.
const SCANCEL: &str = r#"#!/bin/bash
echo "scancel $*" >> "$STAND_INS/commands"
[[ $1 == --signal=TERM && $(< "$STAND_INS/state") == RUNNING ]] && kill -TERM $(< "$STAND_INS/tasks")
"#;
/// Prints the state of the job.
const SQUEUE: &str = r#"#!/bin/bash
echo "squeue $*" >> "$STAND_INS/commands"
cat "$STAND_INS/state"
"#;
/// Makes the minutes of the batch file short.
const SLEEP: &str = "#!/bin/bash\nexec /bin/sleep 0.02\n";
const POLL: Duration = Duration::from_millis(50);

/// A directory with the stand-ins, in which one job is started once or several times.
struct Slurm {
    directory: TempDir,
    number: u16,
    /// The learner and the actors.
    tasks: usize,
    /// The cores that the job has on each of its nodes.
    cores: &'static [usize],
}

impl Slurm {
    /// A job with three tasks on two nodes, the first of which has a core only for the learner. Its number is the first one from `least`
    /// on whose port is free.
    fn new(least: u16) -> Result<Self> {
        let is_free = |number: &u16| TcpListener::bind(("0.0.0.0", 20_000 + number)).is_ok();
        let number = (least..least + 100).find(is_free).context("no port is free")?;
        let slurm = Self { directory: tempfile::tempdir()?, number, tasks: 3, cores: &[1, 2] };
        for (name, script) in [("srun", SRUN), ("scontrol", SCONTROL), ("scancel", SCANCEL), ("squeue", SQUEUE)] {
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

    /// Starts the batch file. The learner has a small experiment and these options.
    fn start(&self, options: &[&str]) -> Result<Job> {
        let directory = self.directory.path();
        // The tasks of an earlier start have ended.
        let _ = fs::remove_file(directory.join("tasks"));
        let free = directory.join("free");
        let _ = fs::remove_dir_all(&free);
        fs::create_dir(&free)?;
        for (node, cores) in self.cores.iter().enumerate() {
            for core in 0..*cores {
                File::create(free.join(format!("{}.{core}", node + 1)))?;
            }
        }
        self.set_state("RUNNING")?;
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
        command.env("SLURM_NTASKS", self.tasks.to_string()).env("SLURM_CPUS_PER_TASK", "1");
        command.env("SLURM_JOB_NUM_NODES", self.cores.len().to_string());
        command.stdin(Stdio::null()).stdout(output.try_clone()?).stderr(output).process_group(0);
        Ok(Job { script: command.spawn().context("cannot start bash")?, log })
    }

    /// The run's directory, if the user names no other.
    fn run(&self) -> PathBuf {
        self.directory.path().join(format!("runs/slurm-{}", self.number))
    }

    /// Sets the state that `squeue` prints.
    fn set_state(&self, state: &str) -> Result<()> {
        Ok(fs::write(self.directory.path().join("state"), state)?)
    }

    /// The commands that the batch file gave to Slurm, one a line.
    fn commands(&self) -> Result<String> {
        Ok(fs::read_to_string(self.directory.path().join("commands"))?)
    }

    /// The tasks of the job.
    fn processes(&self) -> Result<Vec<Pid>> {
        let tasks = fs::read_to_string(self.directory.path().join("tasks"))?;
        tasks.split_whitespace().map(|pid| Pid::from_raw(pid.parse()?).context("no process has this number")).collect()
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

/// Waits for the learner's first update.
fn first_update(job: &mut Job, run: &Path) -> Result<()> {
    let deadline = Instant::now() + LIMIT;
    while updates(run) == 0 {
        ensure!(job.script.try_wait()?.is_none() && Instant::now() < deadline, "no update: {}", job.log());
        sleep(POLL);
    }
    ensure!(checkpoint_in(run).is_none(), "a later checkpoint would prove nothing");
    Ok(())
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
    first_update(&mut job, &run)?;
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
fn a_job_on_one_node_gives_its_cores_to_the_learner_and_its_actors() -> Result<()> {
    let slurm = Slurm { cores: &[3], ..Slurm::new(9400)? };
    let mut job = slurm.start(&["--set", "budget.updates=20"])?;
    let status = job.ends()?;
    ensure!(status.success(), "{status}: {}", job.log());
    Ok(())
}

#[test]
fn a_cancelled_job_is_not_requeued() -> Result<()> {
    let slurm = Slurm::new(9500)?;
    let run = slurm.run();
    let mut job = slurm.start(&["--set", "learner.checkpoint_seconds=3600"])?;
    first_update(&mut job, &run)?;
    // Slurm changes the state, and then signals the tasks and the batch file. It signals srun too, but here the learner is faster.
    slurm.set_state("COMPLETING")?;
    for process in slurm.processes()? {
        kill_process(process, Signal::TERM)?;
    }
    kill_process(Pid::from_child(&job.script), Signal::TERM)?;
    let status = job.ends()?;
    ensure!(status.code() == Some(4), "{status}: {}", job.log());
    ensure!(checkpoint_in(&run).is_some(), "the learner was killed: {}", job.log());
    let commands = slurm.commands()?;
    ensure!(!commands.contains("requeue"), "the job would start again: {commands}");
    Ok(())
}

#[test]
fn a_job_of_one_task_names_the_remedy() -> Result<()> {
    let slurm = Slurm { tasks: 1, cores: &[1], ..Slurm::new(9600)? };
    let mut job = slurm.start(&[])?;
    let status = job.ends()?;
    ensure!(status.code() == Some(2) && job.log().contains("--ntasks=2"), "{status}: {}", job.log());
    ensure!(!slurm.run().exists(), "it started something: {}", job.log());
    Ok(())
}

#[test]
fn a_job_whose_actors_get_no_cores_ends() -> Result<()> {
    let slurm = Slurm { cores: &[1, 1], ..Slurm::new(9700)? };
    slurm.stand_in("sleep", SLEEP)?;
    let mut job = slurm.start(&[])?;
    let status = job.ends()?;
    ensure!(status.code() == Some(1), "{status}: {}", job.log());
    ensure!(job.log().contains("Requested nodes are busy"), "no reason: {}", job.log());
    let commands = slurm.commands()?;
    ensure!(commands.contains("scancel --signal=TERM"), "the learner waits for actors: {commands}");
    ensure!(!commands.contains("requeue"), "it would wait again: {commands}");
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
