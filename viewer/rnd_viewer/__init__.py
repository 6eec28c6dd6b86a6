"""Plays an avatar: ``rnd-play`` and the library under it.

From Python, with no display::

    from rnd_runtime.avatar.avatar import Avatar
    from rnd_runtime.core.images import write_image
    from rnd_runtime.motion.motion import load_motion
    from rnd_runtime.playback.frame import FrameRenderer
    from rnd_runtime.shading.light import load_light
    from rnd_viewer.inputs.cameras import CameraOptions, frame_motion, front_path

    avatar, light = Avatar.load("avatar.onnx"), load_light("sky.exr")
    motion = load_motion("walk.npz", avatar.skeleton)
    view = CameraOptions(width=512, height=512, fov_y=0.6, elevation=0.1)
    camera_at = front_path(frame_motion(avatar.skeleton, motion), view)
    renderer = FrameRenderer(avatar, light, raster="auto")
    write_image("frame.png", renderer.render(motion, 0.5, camera_at(15, 0.5)).srgb)
"""
