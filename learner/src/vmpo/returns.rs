//! Targets of the value function.

use tch::Tensor;

/// One target for each step and reward term, without gradient: `[B, T, R]`.
///
/// G_t = r_t + γ d_t [(1 − λ) V(s_{t+1}) + λ G_{t+1}] where row t is a transition, G_t = V(s_t) where it is not, and
/// G_T = V(s_T). With λ = 1 this is the paper's n-step return to the unroll's end. A row without a transition holds an
/// episode's last observation. A truncated episode is bootstrapped there; a terminated one has d = 0 before it. So no
/// reward of one episode enters the target of another.
///
/// - `reward`: `[B, T, R]`.
/// - `discount`: `[B, T]`, 0 where the episode terminated.
/// - `valid`: `[B, T]`, 1 where the row is a transition.
/// - `values`: V(s), `[B, T+1, R]`.
pub fn returns(reward: &Tensor, discount: &Tensor, valid: &Tensor, values: &Tensor, gamma: f64, lambda: f64) -> Tensor {
    tch::no_grad(|| {
        let steps = reward.size()[1];
        let transition = valid.gt(0.5).unsqueeze(-1);
        let discount = (discount * gamma).unsqueeze(-1);
        let mut base = reward.shallow_clone();
        if lambda < 1.0 {
            base = &discount * values.narrow(1, 1, steps) * (1.0 - lambda) + base;
        }
        let passed_on = discount * lambda;
        let mut target = values.select(1, steps);
        let mut targets = Vec::with_capacity(steps as usize);
        for t in (0..steps).rev() {
            let continued = base.select(1, t) + passed_on.select(1, t) * target;
            target = continued.where_self(&transition.select(1, t), &values.select(1, t));
            targets.push(target.shallow_clone());
        }
        targets.reverse();
        Tensor::stack(&targets, 1)
    })
}
