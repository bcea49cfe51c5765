"""Vision-language models: what they are asked about the past, and the subgoals that they write.

| files | content |
| --- | --- |
| `models`, `openai`, `transformers`, `images` | models, and their input |
| `prompt_files`, `published_prompts` | prompts as files, and those of the paper's systems |
| `question_run`, `questions` | runs of questions, and who answers: a model, or a control |
| `subgoal_settings` | the writer of subgoals that the settings of a run name |
| `subgoal_writers`, `subgoal_prompt` | writers of subgoals, and their prompts |
"""
