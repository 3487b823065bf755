"use strict"
// The view of a mould by WebGL 2, without a library. It is drawn only when something has changed.
;(() => {
const figure = document.getElementById("mould-view"), canvas = figure.querySelector("canvas")
const mesh = JSON.parse(document.getElementById("mould-mesh").textContent)
const bytes = text => Uint8Array.from(atob(text), letter => letter.charCodeAt(0))
const vertices = bytes(mesh.vertices), triangles = bytes(mesh.triangles)

const VERTEX = `#version 300 es
in vec3 fraction;
uniform vec3 low, size;
uniform mat4 camera;
out vec3 position;
void main() {
  position = low + fraction * size;
  gl_Position = camera * vec4(position, 1.);
}`

// Triangles are flat: the normal is that of the plane through the positions of neighbouring pixels.
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 position;
uniform vec3 low, size, eye, right, up, toward;
uniform vec4 tops[${Math.max(1, mesh.tops.length)}];
out vec4 colour;
void main() {
  vec3 normal = normalize(cross(dFdx(position), dFdy(position)));
  if (dot(normal, eye - position) < 0.) normal = -normal;
  vec3 base = mix(vec3(.80, .79, .76), vec3(.95, .945, .93), clamp((position.z - low.z) / max(size.z, 1e-6), 0., 1.));
  if (normal.z > .9)
    for (int i = 0; i < ${mesh.tops.length}; i++)
      if (abs(position.z - tops[i].x) < .02) base = tops[i].yzw;
  vec3 lamp = normalize(-.45 * right + .55 * up + .7 * toward);
  float light = .46 + .46 * max(dot(normal, lamp), 0.) + .12 * max(dot(normal, toward), 0.);
  colour = vec4(base * light, 1.);
}`

const TAN_HALF_FIELD = Math.tan(15 * Math.PI / 180)
const START = { azimuth: -0.5, elevation: 0.85, zoom: 1, shift: [0, 0, 0] }
const ABOVE = { azimuth: 0, elevation: Math.PI / 2 }
const middle = mesh.low.map((low, i) => low + mesh.size[i] / 2)
const radius = Math.hypot(...mesh.size) / 2
const pose = { ...START }
let gl = null, uniforms = {}, isScheduled = false

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
const clamp = (x, low, high) => Math.min(Math.max(x, low), high)
const aspect = () => canvas.clientWidth / Math.max(1, canvas.clientHeight)

// Return the directions to the right of the camera, above it and behind it.
function axes({ azimuth, elevation }) {
  const [s, c] = [Math.sin(azimuth), Math.cos(azimuth)], [t, d] = [Math.sin(elevation), Math.cos(elevation)]
  return [[c, s, 0], [-t * s, t * c, d], [d * s, -d * c, t]]
}

// Return the distance from which all corners of the mould's box are in view.
function fitDistance(from) {
  const [right, up, back] = axes(from)
  let distance = 0
  for (let corner = 0; corner < 8; corner++) {
    const at = mesh.size.map((side, i) => side * ((corner >> i & 1) - .5))
    const offset = Math.max(Math.abs(dot(at, right)) / aspect(), Math.abs(dot(at, up)))
    distance = Math.max(distance, dot(at, back) + offset / TAN_HALF_FIELD)
  }
  return distance
}

function cameraPose() {
  const [right, up, back] = axes(pose)
  const far = 1.04 * fitDistance(START) / pose.zoom
  const target = middle.map((x, i) => x + pose.shift[i])
  return { right, up, back, far, eye: target.map((x, i) => x + far * back[i]) }
}

function projectionMatrix({ right, up, back, far, eye }) {
  const near = Math.max(far - 2 * radius, far / 100), end = far + 2 * radius
  const x = 1 / (TAN_HALF_FIELD * aspect()), y = 1 / TAN_HALF_FIELD
  const a = (near + end) / (near - end), b = 2 * near * end / (near - end)
  const rows = [[...right.map(v => x * v), -x * dot(right, eye)], [...up.map(v => y * v), -y * dot(up, eye)],
    [...back.map(v => a * v), b - a * dot(back, eye)], [...back.map(v => -v), dot(back, eye)]]
  return [0, 1, 2, 3].flatMap(column => rows.map(row => row[column]))
}

function compileShader(kind, source) {
  const shader = gl.createShader(kind)
  gl.shaderSource(shader, source)
  gl.compileShader(shader)
  return shader
}

// Set WebGL up; return whether the mould can be drawn.
function initialise() {
  gl = canvas.getContext("webgl2", { antialias: true })
  if (!gl || gl.isContextLost()) return false
  const program = gl.createProgram()
  gl.attachShader(program, compileShader(gl.VERTEX_SHADER, VERTEX))
  gl.attachShader(program, compileShader(gl.FRAGMENT_SHADER, FRAGMENT))
  gl.linkProgram(program)
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return false
  gl.useProgram(program)
  uniforms = {}
  for (const name of ["low", "size", "camera", "eye", "right", "up", "toward", "tops"])
    uniforms[name] = gl.getUniformLocation(program, name)
  const fraction = gl.getAttribLocation(program, "fraction")
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer())
  gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW)
  gl.enableVertexAttribArray(fraction)
  gl.vertexAttribPointer(fraction, 3, gl.UNSIGNED_SHORT, true, 0, 0)
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer())
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW)
  gl.uniform3fv(uniforms.low, mesh.low)
  gl.uniform3fv(uniforms.size, mesh.size)
  if (mesh.tops.length) gl.uniform4fv(uniforms.tops, mesh.tops.flat())
  gl.enable(gl.DEPTH_TEST)
  return true
}

function draw() {
  isScheduled = false
  const scale = window.devicePixelRatio || 1
  const width = Math.round(canvas.clientWidth * scale), height = Math.round(canvas.clientHeight * scale)
  if (figure.hidden || !width || !height || gl.isContextLost()) return
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height }
  gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight)
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT)
  const camera = cameraPose()
  gl.uniformMatrix4fv(uniforms.camera, false, projectionMatrix(camera))
  gl.uniform3fv(uniforms.eye, camera.eye)
  gl.uniform3fv(uniforms.right, camera.right)
  gl.uniform3fv(uniforms.up, camera.up)
  gl.uniform3fv(uniforms.toward, camera.back)
  gl.drawElements(gl.TRIANGLES, triangles.length / (mesh.wide ? 4 : 2), mesh.wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT, 0)
}

function redraw() {
  if (!isScheduled) { isScheduled = true; requestAnimationFrame(draw) }
}

function turn(azimuth, elevation) {
  pose.azimuth += azimuth
  pose.elevation = clamp(pose.elevation + elevation, -Math.PI / 2, Math.PI / 2)
  redraw()
}

function zoom(factor) {
  pose.zoom = clamp(pose.zoom * factor, .5, 25)
  redraw()
}

// Shift the view by pixels of the page, so that the point under the finger stays there.
function move(x, y) {
  const { right, up, far } = cameraPose(), step = 2 * far * TAN_HALF_FIELD / Math.max(1, canvas.clientHeight)
  pose.shift = pose.shift.map((at, i) => clamp(at + step * (y * up[i] - x * right[i]), -radius, radius))
  redraw()
}

function setView(from) {
  Object.assign(pose, START, from)
  redraw()
}

const fingers = new Map()
const pinch = () => { // distance of two fingers, and their middle
  const [one, two] = [...fingers.values()]
  return [Math.hypot(one.x - two.x, one.y - two.y), (one.x + two.x) / 2, (one.y + two.y) / 2]
}

canvas.addEventListener("pointerdown", event => {
  fingers.set(event.pointerId, { x: event.clientX, y: event.clientY })
  canvas.setPointerCapture(event.pointerId)
})
canvas.addEventListener("pointermove", event => {
  const finger = fingers.get(event.pointerId)
  if (!finger) return
  const before = fingers.size === 2 ? pinch() : null
  const [x, y] = [event.clientX - finger.x, event.clientY - finger.y]
  Object.assign(finger, { x: event.clientX, y: event.clientY })
  if (before) {
    const after = pinch()
    zoom(after[0] / Math.max(1, before[0]))
    move(after[1] - before[1], after[2] - before[2])
  } else if (event.shiftKey) move(x, y)
  else turn(-x / 150, y / 150)
})
for (const name of ["pointerup", "pointercancel"])
  canvas.addEventListener(name, event => fingers.delete(event.pointerId))

// The wheel scrolls the page unless the view has the focus, or a touchpad reports a pinch (as Ctrl and the wheel).
canvas.addEventListener("wheel", event => {
  if (document.activeElement !== canvas && !event.ctrlKey) return
  event.preventDefault()
  zoom(Math.exp(-(event.deltaMode ? 20 * event.deltaY : event.deltaY) / (event.ctrlKey ? 100 : 500)))
}, { passive: false })

canvas.addEventListener("keydown", event => {
  if (event.ctrlKey || event.altKey || event.metaKey) return
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }
  const [x, y] = arrows[event.key] || [0, 0]
  if (x || y) event.shiftKey ? move(40 * x, 40 * y) : turn(-x / 8, y / 8)
  else if (event.key === "+" || event.key === "=") zoom(1.25)
  else if (event.key === "-") zoom(.8)
  else if (event.key === "0" || event.key === "Home") setView({})
  else return
  event.preventDefault()
})
for (const button of figure.querySelectorAll("button"))
  button.addEventListener("click", {
    in: () => zoom(1.25), out: () => zoom(.8), reset: () => setView({}),
    above: () => setView({ ...ABOVE, zoom: fitDistance(START) / fitDistance(ABOVE) }),
  }[button.dataset.do])

// While the context is lost, the page shows its picture of the mould instead.
canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); figure.hidden = true })
canvas.addEventListener("webglcontextrestored", start)
new ResizeObserver(redraw).observe(canvas)
addEventListener("resize", redraw)

function start() {
  figure.hidden = !initialise()
  if (!figure.hidden) redraw()
}
start()
})()
