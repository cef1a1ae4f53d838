"""Former place of a part of `step_refinement`; remove this file with its last import."""

from .step_refinement import knees as knees, on_finer_steps as on_finer_steps
