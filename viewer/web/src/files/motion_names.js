// The SMPL family's joints, and where its mean bodies have their pelvis (rnd_runtime/motion/readers/smpl_names.py).

const SMPL = [
  "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle", "spine3",
  "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow",
  "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
];
const HANDS = ["left", "right"].flatMap((side) =>
  ["index", "middle", "pinky", "ring", "thumb"].flatMap((finger) => [1, 2, 3].map((k) => `${side}_${finger}${k}`)));
export const NAMES_BY_COUNT = {
  22: SMPL.slice(0, 22), 24: SMPL, 52: [...SMPL.slice(0, 22), ...HANDS],
  55: [...SMPL.slice(0, 22), "jaw", "left_eye", "right_eye", ...HANDS],
};

// Files of that family place the origin, not the pelvis. m
export const SMPL_REST_ROOT = [-0.0018, -0.2233, 0.0282], SMPLX_REST_ROOT = [0.0031, -0.3514, 0.012];
