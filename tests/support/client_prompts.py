"""Files with the structure of the released client's prompts, in other words."""

API = """
class Model:
    def __init__(self, kind):
        if kind == "simple_subgoal":
            self.system_prompt = "Plain steps."
        elif kind == "grounded_subgoal":
            self.system_prompt = "Steps with places."

    def prepare_infer_request(self, image_query, step_idx):
        video_prefix = "<video>" if self.video_path else ""
        if self.subgoal_type == "simple_subgoal":
            if len(self.history_simple_subgoals) == 0:
                user_prompt = f"{video_prefix}Goal: {self.task_goal}\\nNew.\\n<image>Plain?"
            else:
                user_prompt = (
                    f"{video_prefix}Goal: {self.task_goal}\\n"
                    f"Done: {self._wrap_history_subgoals(self.history_simple_subgoals)}\\n"
                    "<image>Plain?"
                )
        else:
            if len(self.history_grounded_subgoals) == 0:
                user_prompt = f"{video_prefix}Goal: {self.task_goal}\\nNew.\\n<image>Where?"
            else:
                user_prompt = (
                    f"{video_prefix}Goal: {self.task_goal}\\n"
                    f"Done: {self._wrap_history_subgoals(self.history_grounded_subgoals)}\\n"
                    "<image>Where?"
                )
"""

API_MEMER = """
class Memory:
    def __init__(self):
        self.system_prompt = "Steps and frames."

    def prepare_infer_request(self):
        video_prefix = "There was a video: <video>\\n" if self.video_path else ""
        key_frame_paths = [key_path for key_path in self.key_frame_paths.values()]
        user_prompt = (
            f"{video_prefix}Goal: {self.task_goal}\\n"
            f"Kept:{self._wrap_images(key_frame_paths)}\\n"
            f"Now: {self._wrap_images(self.current_execution_frame_paths)}\\n\\nStep and frames?"
        )
"""

FILES = {"api.py": API, "api_memer.py": API_MEMER}
