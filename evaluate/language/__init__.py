"""Vision-language models: what they are asked about the past, and the subgoals that they write.

| files | content |
| --- | --- |
| `models`, `openai`, `bounded_http`, `transformers`, `images` | models, and their input |
| `prompt_files`, `published_prompts` | prompts as files, and those of the paper's systems |
| `question_run`, `question_prompt`, `responders` | runs of questions |
| `subgoal_settings` | the writer of subgoals that the settings of a run name |
| `subgoal_writer`, `model_writer`, `subgoal_prompt` | writers of subgoals |
"""
