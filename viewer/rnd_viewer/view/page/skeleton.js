// The skeleton over a frame.

/** Draw the joints of `frame`, whose parents are `parents` [J], on `canvas`; only clear it where not `shown`. */
export function drawSkeleton(canvas, frame, parents, shown) {
  const context = canvas.getContext("2d");
  const scale = Math.max(1, Math.round(1024 / frame.height));
  canvas.width = frame.width * scale;
  canvas.height = frame.height * scale;
  if (!shown) return;
  context.scale(scale, scale);
  context.lineWidth = frame.height / 300;
  context.strokeStyle = "#f2b25c";
  context.fillStyle = "#fff";
  frame.joints.forEach(([x, y, z], joint) => {
    const parent = parents[joint];
    if (parent < 0 || z <= 0 || frame.joints[parent][2] <= 0) return;
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(frame.joints[parent][0], frame.joints[parent][1]);
    context.stroke();
  });
  for (const [x, y, z] of frame.joints) {
    if (z <= 0) continue;
    context.beginPath();
    context.arc(x, y, frame.height / 200, 0, 2 * Math.PI);
    context.fill();
  }
}
