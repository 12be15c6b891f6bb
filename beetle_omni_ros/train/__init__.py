"""Training of the policy: batched environment, PPO, export. The only place that imports torch."""
