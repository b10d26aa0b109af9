//! Retrace (Munos et al., 2016): off-policy targets of the action value.

use tch::{Kind, Tensor};

/// What Retrace is computed from, `[B, T]` each unless said otherwise. All of it is without gradient.
#[derive(Debug)]
pub struct Trace<'a> {
    /// r_t.
    pub reward: &'a Tensor,
    /// γ d_t: 0 where step t ended in failure.
    pub discount: &'a Tensor,
    /// Q′(h′_t, z_t), of the action that was taken.
    pub action_value: &'a Tensor,
    /// V′, `[B, T+1]`: also of the observation after the last step.
    pub value: &'a Tensor,
    /// c_t = λ min(1, π′(z_t) / μ(z_t)).
    pub coefficient: &'a Tensor,
    /// 1 where row t has a transition, else 0.
    pub valid: &'a Tensor,
}

/// Q^ret, `[B, T]`:
///
/// Q^ret_t = r_t + γ d_t (V′_{t+1} + c_{t+1} (Q^ret_{t+1} − Q′_{t+1})),
///
/// with c_{t+1} = 0 where row t + 1 has no transition: after an episode's last observation, and at the end of the sequence.
/// Rows without a transition are 0.
pub fn retrace(trace: &Trace<'_>) -> Tensor {
    let Trace { reward, discount, action_value, value, coefficient, valid } = trace;
    let steps = reward.size()[1];
    let next_value = value.narrow(1, 1, steps);
    let columns = |tensor: &Tensor| tensor.unbind(1);
    let one_step = columns(&(*reward + *discount * next_value));
    let (discounts, action_values) = (columns(discount), columns(action_value));
    let traces = columns(&(*coefficient * *valid));
    let mut targets: Vec<Tensor> = Vec::with_capacity(steps as usize);
    for t in (0..steps as usize).rev() {
        let target = match (targets.last(), traces.get(t + 1), action_values.get(t + 1)) {
            (Some(next), Some(trace), Some(action_value)) => {
                &one_step[t] + &discounts[t] * trace * (next - action_value)
            }
            _ => one_step[t].shallow_clone(),
        };
        targets.push(target);
    }
    targets.reverse();
    Tensor::stack(&targets, 1).where_scalarother(&valid.gt(0.5), 0.0).to_kind(Kind::Float)
}
