//! Ball catching (CoMic supplement 1.3): a ball flies towards the standing humanoid.
//!
//! | constant | value | source |
//! | --- | --- | --- |
//! | start | standing; the ball in mid-air, thrown upwards and towards the humanoid | supplement |
//! | per episode | radius 8 to 15 cm, mass 0.3 to 1.5 kg, spin N(0, 3 rad/s) | random in the supplement, ranges ours |
//! | failure | the ball touches the ground or the head: reward −1 and nothing else, the episode ends | supplement |
//! | touch | +0.01 for each hand's front, −0.01 for each hand's back | supplement |
//! | front of a hand | contacts at z < 0 in the hand's frame, where its touch sensors are | ours |
//! | standing | the get-up reward × 0.01 | supplement |
//! | caught | held by the fronts of both hands, or of one and the torso, for 10 steps | ours |
//! | walking | once caught, up to 0.01 for moving at 1 m/s towards a target 3 m ahead | a "small shaping reward" in the supplement, numbers ours |
//! | length | 6 s, 200 steps | supplement |
//! | throw | from 2 to 3 m ahead, ±0.3 m aside, 0.8 to 1.3 m high; at a point 0.35 m before the chest; 0.6 to 0.9 s of flight | ours |
//! | task observation | ball: position, velocity, angular velocity in the root's frame, radius; target in the root's frame | ours |
//!
//! All of them are fields of [`BallCatch`], except the fronts of the hands.

use std::sync::Arc;

use comic_clips::spatial::{into_frame, subtract};
use comic_experiment::BallCatch;
use rand::{Rng as _, SeedableRng as _};
use rand_distr::{Distribution as _, StandardNormal};
use rand_pcg::Pcg64;

use super::environment::RuledTask;
use super::get_up::standing_reward;
use super::interface::{Rules, Verdict};
use super::poses::Poses;
use super::stage::{Arena, Part, Stage};
use crate::achievement::Achievement;
use crate::arenas::floor;
use crate::build_task::{BuildTask, Context};
use crate::environment::{MAX_REWARD_TERMS, Task};
use crate::error::Error;
use crate::humanoid;
use crate::humanoid::observation::{Number, fill};

/// Gravity, m/s² (MuJoCo's default).
const GRAVITY: f64 = 9.81;
/// First index of the ball's position and quaternion in the coordinates, and of its linear (world) and angular (its own
/// frame) velocity in the velocities. The humanoid's come first.
const BALL_COORDINATES: usize = 63;
const BALL_VELOCITIES: usize = 62;

/// The rules of ball catching.
#[derive(Debug)]
pub(crate) struct BallCatchRules {
    config: BallCatch,
    poses: Poses,
    balls: Vec<Ball>,
}

/// A compiled arena, and the radius of the ball in it, m.
#[derive(Debug)]
struct Ball {
    arena: Arc<Arena>,
    radius: f64,
}

/// The state of an episode.
#[derive(Debug, Default)]
pub(crate) struct State {
    radius: f64,
    /// Consecutive steps in which the ball was held.
    held_steps: u32,
    /// All steps of the episode in which the ball was held.
    all_held_steps: u32,
    caught: bool,
    /// The target of walking after the ball is caught: x and y, m.
    target: [f64; 2],
}

impl BuildTask for BallCatch {
    fn build(&self, context: &Context<'_>) -> Result<Arc<dyn Task>, Error> {
        let poses = Poses::new(self.start_pose, context.catalogue)?;
        let mut random = Pcg64::seed_from_u64(context.experiment.seed);
        let rules = BallCatchRules::new(self, poses, &mut random)?;
        Ok(Arc::new(RuledTask::new(rules, context.spec()?)))
    }
}

impl BallCatchRules {
    /// Compiles the balls. Every episode draws one of them.
    pub(crate) fn new(config: &BallCatch, poses: Poses, random: &mut Pcg64) -> Result<Self, Error> {
        let mut ball = || {
            let radius = uniform(config.radius, random);
            let mass = uniform(config.mass, random);
            let model = humanoid::build_with(floor::with_target()?, |arena| floor::add_ball(arena, radius, mass))?;
            Ok(Ball { arena: Arc::new(Arena::new(model)?), radius })
        };
        let balls = (0..config.balls.max(1)).map(|_| ball()).collect::<Result<_, Error>>()?;
        Ok(Self { config: config.clone(), poses, balls })
    }

    /// Position and velocity of a throw, both in the world's frame.
    fn throw(&self, random: &mut Pcg64) -> ([f64; 3], [f64; 3]) {
        let config = &self.config;
        let from = [uniform(config.distance, random), uniform(config.lateral, random), uniform(config.height, random)];
        let aim = [config.aim_distance, uniform(config.aim_lateral, random), uniform(config.aim_height, random)];
        let time = uniform(config.flight_time, random);
        let mut velocity = subtract(aim, from).map(|distance| distance / time);
        velocity[2] += 0.5 * GRAVITY * time;
        (from, velocity)
    }

    /// Counts the consecutive steps in which the ball was held.
    fn count(&self, holds: bool, state: &mut State) {
        state.held_steps = if holds { state.held_steps.saturating_add(1) } else { 0 };
        state.all_held_steps = state.all_held_steps.saturating_add(u32::from(holds));
        state.caught |= state.held_steps >= self.config.hold_steps;
    }

    /// What touches the ball.
    fn touches(stage: &Stage) -> Touches {
        let mut touches = Touches::default();
        for (one, other, place) in stage.contacts() {
            let part = match (one, other) {
                (Part::Ball, part) | (part, Part::Ball) => part,
                _ => continue,
            };
            match part {
                Part::Ground | Part::Head => touches.failure = true,
                Part::Torso => touches.torso = true,
                Part::LeftHand | Part::RightHand => {
                    let hand = usize::from(part == Part::RightHand);
                    let body = stage.arena.hands[hand];
                    let offset = subtract(place, stage.data.xpos()[body]);
                    let [_, _, z] = into_frame(&stage.data.xmat()[body], offset);
                    touches.sides[hand][usize::from(z >= 0.0)] = true;
                }
                Part::Foot | Part::Body | Part::Ball | Part::Other => {}
            }
        }
        touches
    }
}

/// What touches the ball.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Touches {
    /// The ground or the head.
    failure: bool,
    torso: bool,
    /// Front and back of the left and the right hand.
    sides: [[bool; 2]; 2],
}

impl Touches {
    /// Number of hands that touch with the front, minus those that touch with the back.
    fn score(self) -> f64 {
        self.sides.iter().map(|[front, back]| f64::from(u8::from(*front)) - f64::from(u8::from(*back))).sum()
    }

    fn holds(self) -> bool {
        let [[left, _], [right, _]] = self.sides;
        (left && right) || ((left || right) && self.torso)
    }
}

fn uniform([low, high]: [f64; 2], random: &mut Pcg64) -> f64 {
    random.random_range(low..=high)
}

impl Rules for BallCatchRules {
    type State = State;

    fn stage(&self, random: &mut Pcg64) -> Result<Stage, Error> {
        Ok(Stage::new(Arc::clone(&self.balls[random.random_range(0..self.balls.len())].arena)))
    }

    fn begin(&self, stage: &mut Stage, state: &mut State, random: &mut Pcg64) {
        let Ball { arena, radius } = &self.balls[random.random_range(0..self.balls.len())];
        stage.enter(Arc::clone(arena));
        *state = State { radius: *radius, target: [self.config.target_distance, 0.0], ..State::default() };
        let pose = self.poses.draw(random);
        let (position, velocity) = self.throw(random);
        let spin: [f64; 3] = std::array::from_fn(|_| {
            let draw: f64 = StandardNormal.sample(random);
            self.config.spin * draw
        });
        let qpos = [&pose.qpos[..], &position, &[1.0, 0.0, 0.0, 0.0]].concat();
        let qvel = [&pose.qvel[..], &velocity, &spin].concat();
        stage.place(&qpos, &qvel);
    }

    fn judge(&self, stage: &mut Stage, state: &mut State, _: &mut Pcg64) -> Verdict {
        let config = &self.config;
        let touches = Self::touches(stage);
        let mut reward_terms = [0.0; MAX_REWARD_TERMS];
        if touches.failure {
            reward_terms[0] = config.failure_reward;
            return Verdict { reward_terms, failed: true };
        }
        self.count(touches.holds(), state);
        reward_terms[1] = config.touch_reward * touches.score();
        reward_terms[2] = config.standing_reward * standing_reward(stage.head_height(), config.target_height);
        if state.caught {
            let (root, _) = stage.root();
            let way = [state.target[0] - root[0], state.target[1] - root[1]];
            let velocity = stage.data.qvel();
            let speed = (velocity[0] * way[0] + velocity[1] * way[1]) / way[0].hypot(way[1]).max(1e-6);
            reward_terms[3] = config.walking_reward * (speed / config.walking_speed).clamp(0.0, 1.0);
        }
        Verdict { reward_terms, failed: false }
    }

    /// The steps in which the ball was held. Success: the ball was caught, also if it fell later.
    fn achievement(&self, _: &Stage, state: &State, _: bool) -> Achievement {
        Achievement::new(state.caught).measuring(&["held_steps"], [f64::from(state.all_held_steps)])
    }

    fn observe<T: Number>(&self, stage: &Stage, state: &State, out: &mut [T]) {
        let (root, rotation) = stage.root();
        let (qpos, qvel) = (&stage.data.qpos()[BALL_COORDINATES..], &stage.data.qvel()[BALL_VELOCITIES..]);
        let position = into_frame(rotation, subtract([qpos[0], qpos[1], qpos[2]], *root));
        let velocity = into_frame(rotation, [qvel[0], qvel[1], qvel[2]]);
        // MuJoCo gives a free body's angular velocity in the body's own frame.
        let ball = stage.arena.ball.unwrap_or_default();
        let own = &stage.data.xmat()[ball];
        let in_world = std::array::from_fn(|row| (0..3).map(|column| own[3 * row + column] * qvel[3 + column]).sum());
        let spin = into_frame(rotation, in_world);
        let [x, y] = state.target;
        let target = into_frame(rotation, subtract([x, y, 0.0], *root));
        fill(out, position.into_iter().chain(velocity).chain(spin).chain([state.radius]).chain(target));
    }

    fn time_limit(&self) -> f64 {
        self.config.time_limit
    }

    fn target(&self, state: &State) -> Option<[f64; 2]> {
        Some(state.target)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rules(config: &BallCatch) -> BallCatchRules {
        BallCatchRules::new(config, Poses::upright(), &mut Pcg64::seed_from_u64(1)).unwrap()
    }

    /// A stage with the first state of an episode, the rules' state and the random number generator.
    fn first_state(rules: &BallCatchRules) -> (Stage, State, Pcg64) {
        let (mut random, mut state) = (Pcg64::seed_from_u64(2), State::default());
        let mut stage = rules.stage(&mut random).unwrap();
        rules.begin(&mut stage, &mut state, &mut random);
        (stage, state, random)
    }

    /// Puts the ball at rest at a position in the world, m.
    fn put(stage: &mut Stage, place: [f64; 3]) {
        let (mut qpos, mut qvel) = (stage.data.qpos().to_vec(), stage.data.qvel().to_vec());
        qpos[BALL_COORDINATES..BALL_COORDINATES + 3].copy_from_slice(&place);
        qvel[BALL_VELOCITIES..].fill(0.0);
        stage.place(&qpos, &qvel);
    }

    /// The position at which the ball overlaps a hand by a centimetre, on the front (`side` −1) or on the back (+1).
    fn at_hand(stage: &Stage, hand: usize, side: f64, radius: f64) -> [f64; 3] {
        let body = stage.arena.hands[hand];
        let (place, rotation) = (stage.data.xpos()[body], stage.data.xmat()[body]);
        // 2.5 cm is about half a hand's thickness.
        let offset = side * (radius + 0.015);
        std::array::from_fn(|axis| place[axis] + offset * rotation[3 * axis + 2])
    }

    fn one_size() -> BallCatch {
        BallCatch { radius: [0.1, 0.1], balls: 1, ..BallCatch::default() }
    }

    #[test]
    fn a_ball_on_the_ground_or_the_head_fails_with_a_reward_of_minus_one() {
        let rules = rules(&one_size());
        let (mut stage, mut state, mut random) = first_state(&rules);
        let head = {
            let [.., head] = stage.arena.walker.appendages;
            stage.data.xpos()[head]
        };
        for place in [[2.0, 0.0, 0.095], [head[0] + 0.12, head[1], head[2] + 0.12]] {
            put(&mut stage, place);
            let verdict = rules.judge(&mut stage, &mut state, &mut random);
            assert!(verdict.failed, "{place:?}");
            assert_eq!(verdict.reward_terms, [-1.0, 0.0, 0.0, 0.0, 0.0]);
        }
        put(&mut stage, [2.0, 0.0, 0.5]);
        assert!(!rules.judge(&mut stage, &mut state, &mut random).failed, "a ball in the air");
    }

    #[test]
    fn the_front_of_a_hand_gives_a_hundredth_and_the_back_takes_one() {
        let rules = rules(&one_size());
        let (mut stage, mut state, mut random) = first_state(&rules);
        for hand in [0, 1] {
            for (side, expected) in [(-1.0, 0.01), (1.0, -0.01)] {
                let place = at_hand(&stage, hand, side, 0.1);
                put(&mut stage, place);
                let verdict = rules.judge(&mut stage, &mut state, &mut random);
                assert_eq!(verdict.reward_terms[1], expected, "hand {hand}, side {side}");
            }
        }
    }

    #[test]
    fn scores_and_holds_count_hands() {
        let touch = |sides, torso| Touches { failure: false, torso, sides };
        let (front, back, both, none) = ([true, false], [false, true], [true, true], [false, false]);
        for (sides, torso, score, holds) in [
            ([front, front], false, 2.0, true),
            ([back, back], false, -2.0, false),
            ([both, front], false, 1.0, true),
            ([front, none], true, 1.0, true),
            ([front, none], false, 1.0, false),
            ([none, none], true, 0.0, false),
        ] {
            let touches = touch(sides, torso);
            assert_eq!((touches.score(), touches.holds()), (score, holds), "{sides:?} {torso}");
        }
    }

    #[test]
    fn standing_gives_at_most_a_hundredth() {
        let rules = rules(&one_size());
        let (mut stage, mut state, mut random) = first_state(&rules);
        let verdict = rules.judge(&mut stage, &mut state, &mut random);
        assert!((verdict.reward_terms[2] - 0.01).abs() < 1e-6, "{verdict:?}");
        for _ in 0..60 {
            stage.step(&[0.0; 56]);
        }
        put(&mut stage, [2.0, 0.0, 2.0]);
        let verdict = rules.judge(&mut stage, &mut state, &mut random);
        assert!((0.0..0.005).contains(&verdict.reward_terms[2]), "a fallen body: {verdict:?}");
    }

    #[test]
    fn walking_gives_a_reward_only_after_the_ball_was_caught() {
        let rules = rules(&one_size());
        let (mut stage, _, mut random) = first_state(&rules);
        let (mut qpos, mut qvel) = (stage.data.qpos().to_vec(), stage.data.qvel().to_vec());
        qpos[BALL_COORDINATES..BALL_COORDINATES + 3].copy_from_slice(&[2.0, 0.0, 2.0]);
        for (speed, expected) in [(0.5, 0.005), (2.0, 0.01), (-1.0, 0.0)] {
            qvel[0] = speed;
            stage.place(&qpos, &qvel);
            for (caught, expected) in [(false, 0.0), (true, expected)] {
                let mut state = State { caught, target: [3.0, 0.0], radius: 0.1, ..State::default() };
                let verdict = rules.judge(&mut stage, &mut state, &mut random);
                assert!((verdict.reward_terms[3] - expected).abs() < 1e-12, "{speed} {caught}: {verdict:?}");
            }
        }
    }

    #[test]
    fn a_ball_is_caught_after_ten_consecutive_steps() {
        let rules = rules(&one_size());
        let (mut stage, mut state, mut random) = first_state(&rules);
        for (holds, caught) in (0..9).map(|_| (true, false)).chain([(false, false)]) {
            rules.count(holds, &mut state);
            assert_eq!(state.caught, caught);
        }
        for step in 1..=12 {
            rules.count(true, &mut state);
            let achieved = rules.achievement(&stage, &state, false);
            assert_eq!((state.caught, achieved.success), (step >= 10, step >= 10), "step {step}");
        }
        put(&mut stage, [2.0, 0.0, 0.095]);
        assert!(rules.judge(&mut stage, &mut state, &mut random).failed);
        let achieved = rules.achievement(&stage, &state, true);
        assert!(achieved.success, "a ball that is dropped later was caught");
        assert_eq!(achieved.measures().collect::<Vec<_>>(), [("held_steps", 21.0)]);
    }

    #[test]
    fn throws_go_up_and_reach_their_aim_in_time() {
        let (config, mut random) = (BallCatch::default(), Pcg64::seed_from_u64(3));
        let rules = rules(&BallCatch { balls: 1, ..config.clone() });
        for _ in 0..200 {
            let (from, velocity) = rules.throw(&mut random);
            let within = |value: f64, [low, high]: [f64; 2]| (low..=high).contains(&value);
            assert!(within(from[0], config.distance) && within(from[1], config.lateral));
            assert!(within(from[2], config.height));
            assert!(velocity[2] > 0.0 && velocity[0] < 0.0, "upwards and towards the humanoid");
            let time = (config.aim_distance - from[0]) / velocity[0];
            assert!(within(time, config.flight_time));
            let arrival = from[2] + velocity[2] * time - 0.5 * GRAVITY * time * time;
            assert!(within(arrival, [1.1 - 1e-9, 1.5 + 1e-9]), "{arrival}");
        }
    }

    #[test]
    fn balls_of_different_episodes_differ_in_size_and_mass() {
        let rules = rules(&BallCatch { balls: 8, ..BallCatch::default() });
        let (mut stage, mut state, mut random) = first_state(&rules);
        let mut seen = std::collections::BTreeSet::new();
        for _ in 0..100 {
            rules.begin(&mut stage, &mut state, &mut random);
            let body = stage.arena.ball.unwrap();
            let model = stage.arena.models.shared();
            let (mass, geom) = (model.body_mass()[body], model.body_geomadr()[body] as usize);
            assert_eq!(model.geom_size()[geom][0], state.radius);
            assert!((0.08..=0.15).contains(&state.radius) && (0.3..=1.5).contains(&mass));
            seen.insert((state.radius.to_bits(), mass.to_bits()));
        }
        assert_eq!(seen.len(), 8);
    }
}
