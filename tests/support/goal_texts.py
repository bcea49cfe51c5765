"""Goal texts and the families that they fit."""

UNMASK = ("VideoUnmask", "VideoUnmaskSwap")

# Our own sentences, each said as a person could say it.
GOALS: dict[str, tuple[str, ...]] = {
    "Put 2 red cubes and one teal cube into the bin and press the button.": ("BinFill",),
    "pick up the violet cube and place it on the target five times": ("PickXtimes",),
    "Take the cube to the right-side target, next to the left-side target.": ("SwingXtimes",),
    "press the button to stop the cube on its 7th visit of the target": ("StopCube",),
    "See the video, then lift the container hiding the pink cube": UNMASK,
    "After the video: lift the containers that hide the red and the blue cube": UNMASK,
    "press the button, then lift the container that hides the orange cube": ("ButtonUnmask",),
    "press both buttons, then lift the container hiding the cube": ("ButtonUnmaskSwap",),
    "Press the button and collect every highlighted cube": ("PickHighlight",),
    "as in the video, pick up the same blue cube twice": ("VideoRepick",),
    "as in the video, pick up the same block again and press the button": ("VideoRepick",),
    "From the video: place the red cube on the target where it was before the button was pressed": (
        "VideoPlaceButton",
    ),
    "From the video: place the red cube on the 3rd target it lay on": ("VideoPlaceOrder",),
    "From the video: place the red cube on the fourth target it lay on": ("VideoPlaceOrder",),
    "see the video and move the cube in the same manner": ("MoveCube",),
    "see the video and insert the same peg at the same end": ("InsertPeg",),
    "see the video and retrace the same pattern": ("PatternLock",),
    "see the video and navigate around the sticks on the same path": ("RouteStick",),
    "open the upper drawer": (),
    "": (),
}
