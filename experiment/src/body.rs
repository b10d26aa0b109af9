//! The humanoid's sizes: what it does, feels and sees at every step.

/// Length of a control step of the tasks without a reference, s (S). Tracking has that of its clips.
pub const CONTROL_TIMESTEP: f64 = 0.03;
/// Hinges of the CMU humanoid. Each has one actuator.
pub const ACTION_SIZE: usize = 56;
/// Tracking bodies of the V2020 humanoid; `face` is one of them.
pub(crate) const BODIES: usize = 31;
/// Height and width of the egocentric camera's image, in pixels of three bytes (C).
pub const IMAGE_SIZE: usize = 64;
/// The parts of proprioception (supplement 1.1, in MoCapAct's order): dm_control's name without `walker/`, and how many
/// numbers the part has.
pub const PROPRIOCEPTION: [(&str, usize); 9] = [
    ("joints_pos", ACTION_SIZE),
    ("joints_vel", ACTION_SIZE),
    ("sensors_velocimeter", 3),
    ("sensors_gyro", 3),
    ("end_effectors_pos", 12),
    ("world_zaxis", 3),
    ("actuator_activation", ACTION_SIZE),
    ("sensors_touch", 10),
    ("sensors_torque", 6),
];
/// Length of proprioception: the sum of the sizes in [`PROPRIOCEPTION`].
pub const PROPRIOCEPTION_SIZE: usize = 205;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn proprioception_is_as_long_as_its_parts() {
        assert_eq!(PROPRIOCEPTION.iter().map(|(_, size)| size).sum::<usize>(), PROPRIOCEPTION_SIZE);
    }
}
