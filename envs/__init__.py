"""Environments; importing this package registers them with gymnasium."""

import gymnasium

gymnasium.register(
    id="ventosa/Grasp-v0",
    entry_point="envs.grasp.env:GraspEnv",
    vector_entry_point="envs.grasp.env:make_vector_env",
)
