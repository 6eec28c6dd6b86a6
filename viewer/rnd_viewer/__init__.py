"""Plays an avatar: ``rnd-play`` and the library under it.

From Python, with no display::

    from rnd_runtime.avatar import Avatar
    from rnd_runtime.images import write_image
    from rnd_runtime.light import load_light
    from rnd_runtime.motion import load_motion
    from rnd_runtime.raster import make_rasterizer
    from rnd_runtime.shading import Shader
    from rnd_viewer.cameras import CameraOptions, frame_motion, front_path
    from rnd_viewer.player import Player

    avatar, light = Avatar.load("avatar.onnx"), load_light("sky.exr")
    motion = load_motion("walk.npz", avatar.skeleton)
    view = CameraOptions(width=512, height=512, fov_y=0.6, elevation=0.1)
    camera_at = front_path(frame_motion(avatar.skeleton, motion), view)
    player = Player(avatar, light, Shader(light), make_rasterizer("auto"))
    write_image("frame.png", player.render(motion, 0.5, camera_at(15, 0.5)).srgb)
"""
