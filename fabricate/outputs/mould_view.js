"use strict"
// The view of a mould: WebGL 2 without a library. Drawn when something has changed, and never else.
;(() => {
const figure = document.getElementById("mould-view"), canvas = figure.querySelector("canvas")
const mesh = JSON.parse(document.getElementById("mould-mesh").textContent)
const bytes = text => Uint8Array.from(atob(text), letter => letter.charCodeAt(0))
const vertices = bytes(mesh.vertices), triangles = bytes(mesh.triangles)

const VERTEX = `#version 300 es
in vec3 share;
uniform vec3 low, size;
uniform mat4 camera;
out vec3 place;
void main() {
  place = low + share * size;
  gl_Position = camera * vec4(place, 1.);
}`

// Every triangle is flat: its normal is that of the plane which the places of neighbouring pixels lie in.
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 place;
uniform vec3 low, size, eye, right, up, toward;
uniform vec4 tops[${Math.max(1, mesh.tops.length)}];
out vec4 colour;
void main() {
  vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
  if (dot(normal, eye - place) < 0.) normal = -normal;
  vec3 base = mix(vec3(.80, .79, .76), vec3(.95, .945, .93), clamp((place.z - low.z) / max(size.z, 1e-6), 0., 1.));
  if (normal.z > .9)
    for (int i = 0; i < ${mesh.tops.length}; i++)
      if (abs(place.z - tops[i].x) < .02) base = tops[i].yzw;
  vec3 lamp = normalize(-.45 * right + .55 * up + .7 * toward);
  float light = .46 + .46 * max(dot(normal, lamp), 0.) + .12 * max(dot(normal, toward), 0.);
  colour = vec4(base * light, 1.);
}`

const FIELD = Math.tan(15 * Math.PI / 180)
const START = { around: -0.5, over: 0.85, zoom: 1, shift: [0, 0, 0] }
const ABOVE = { around: 0, over: Math.PI / 2 }
const middle = mesh.low.map((low, i) => low + mesh.size[i] / 2)
const reach = Math.hypot(...mesh.size) / 2
const pose = { ...START }
let gl = null, spots = {}, waiting = false

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
const limited = (x, low, high) => Math.min(Math.max(x, low), high)
const aspect = () => canvas.clientWidth / Math.max(1, canvas.clientHeight)

// Directions of the camera's right, up and back, for a pad seen from `around` its upright axis and from `over` it.
function axes({ around, over }) {
  const [s, c] = [Math.sin(around), Math.cos(around)], [t, d] = [Math.sin(over), Math.cos(over)]
  return [[c, s, 0], [-t * s, t * c, d], [d * s, -d * c, t]]
}

// How far away all corners of the box are seen.
function away(from) {
  const [right, up, back] = axes(from)
  let most = 0
  for (let corner = 0; corner < 8; corner++) {
    const at = mesh.size.map((side, i) => side * ((corner >> i & 1) - .5))
    most = Math.max(most, dot(at, back) + Math.max(Math.abs(dot(at, right)) / aspect(), Math.abs(dot(at, up))) / FIELD)
  }
  return most
}

function seen() {
  const [right, up, back] = axes(pose)
  const far = 1.04 * away(START) / pose.zoom
  const target = middle.map((x, i) => x + pose.shift[i])
  return { right, up, back, far, eye: target.map((x, i) => x + far * back[i]) }
}

function matrix({ right, up, back, far, eye }) {
  const near = Math.max(far - 2 * reach, far / 100), end = far + 2 * reach
  const x = 1 / (FIELD * aspect()), y = 1 / FIELD
  const a = (near + end) / (near - end), b = 2 * near * end / (near - end)
  const rows = [[...right.map(v => x * v), -x * dot(right, eye)], [...up.map(v => y * v), -y * dot(up, eye)],
    [...back.map(v => a * v), b - a * dot(back, eye)], [...back.map(v => -v), dot(back, eye)]]
  return [0, 1, 2, 3].flatMap(column => rows.map(row => row[column]))
}

function compiled(kind, source) {
  const shader = gl.createShader(kind)
  gl.shaderSource(shader, source)
  gl.compileShader(shader)
  return shader
}

// Whether the mould can be drawn.
function begin() {
  gl = canvas.getContext("webgl2", { antialias: true })
  if (!gl || gl.isContextLost()) return false
  const program = gl.createProgram()
  gl.attachShader(program, compiled(gl.VERTEX_SHADER, VERTEX))
  gl.attachShader(program, compiled(gl.FRAGMENT_SHADER, FRAGMENT))
  gl.linkProgram(program)
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return false
  gl.useProgram(program)
  spots = {}
  for (const name of ["low", "size", "camera", "eye", "right", "up", "toward", "tops"])
    spots[name] = gl.getUniformLocation(program, name)
  const share = gl.getAttribLocation(program, "share")
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer())
  gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW)
  gl.enableVertexAttribArray(share)
  gl.vertexAttribPointer(share, 3, gl.UNSIGNED_SHORT, true, 0, 0)
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer())
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW)
  gl.uniform3fv(spots.low, mesh.low)
  gl.uniform3fv(spots.size, mesh.size)
  if (mesh.tops.length) gl.uniform4fv(spots.tops, mesh.tops.flat())
  gl.enable(gl.DEPTH_TEST)
  return true
}

function draw() {
  waiting = false
  const scale = window.devicePixelRatio || 1
  const width = Math.round(canvas.clientWidth * scale), height = Math.round(canvas.clientHeight * scale)
  if (figure.hidden || !width || !height || gl.isContextLost()) return
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height }
  gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight)
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT)
  const camera = seen()
  gl.uniformMatrix4fv(spots.camera, false, matrix(camera))
  gl.uniform3fv(spots.eye, camera.eye)
  gl.uniform3fv(spots.right, camera.right)
  gl.uniform3fv(spots.up, camera.up)
  gl.uniform3fv(spots.toward, camera.back)
  gl.drawElements(gl.TRIANGLES, triangles.length / (mesh.wide ? 4 : 2), mesh.wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT, 0)
}

function redraw() {
  if (!waiting) { waiting = true; requestAnimationFrame(draw) }
}

function turn(around, over) {
  pose.around += around
  pose.over = limited(pose.over + over, -Math.PI / 2, Math.PI / 2)
  redraw()
}

function zoom(factor) {
  pose.zoom = limited(pose.zoom * factor, .5, 25)
  redraw()
}

// By pixels of the page, so that what is under the finger stays there.
function move(x, y) {
  const { right, up, far } = seen(), step = 2 * far * FIELD / Math.max(1, canvas.clientHeight)
  pose.shift = pose.shift.map((at, i) => limited(at + step * (y * up[i] - x * right[i]), -reach, reach))
  redraw()
}

function look(from) {
  Object.assign(pose, START, from)
  redraw()
}

const fingers = new Map()
const spread = () => {
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
  const before = fingers.size === 2 ? spread() : null
  const [x, y] = [event.clientX - finger.x, event.clientY - finger.y]
  Object.assign(finger, { x: event.clientX, y: event.clientY })
  if (before) {
    const after = spread()
    zoom(after[0] / Math.max(1, before[0]))
    move(after[1] - before[1], after[2] - before[2])
  } else if (event.shiftKey) move(x, y)
  else turn(-x / 150, y / 150)
})
for (const name of ["pointerup", "pointercancel"])
  canvas.addEventListener(name, event => fingers.delete(event.pointerId))

// The wheel scrolls the page unless the view was clicked, or the fingers pinch on a touchpad.
canvas.addEventListener("wheel", event => {
  if (document.activeElement !== canvas && !event.ctrlKey) return
  event.preventDefault()
  zoom(Math.exp(-(event.deltaMode ? 20 * event.deltaY : event.deltaY) / (event.ctrlKey ? 100 : 500)))
}, { passive: false })

canvas.addEventListener("keydown", event => {
  if (event.ctrlKey || event.altKey || event.metaKey) return
  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }
  const [x, y] = ways[event.key] || [0, 0]
  if (x || y) event.shiftKey ? move(40 * x, 40 * y) : turn(-x / 8, y / 8)
  else if (event.key === "+" || event.key === "=") zoom(1.25)
  else if (event.key === "-") zoom(.8)
  else if (event.key === "0" || event.key === "Home") look({})
  else return
  event.preventDefault()
})
for (const button of figure.querySelectorAll("button"))
  button.addEventListener("click", {
    in: () => zoom(1.25), out: () => zoom(.8), reset: () => look({}), 
    above: () => look({ ...ABOVE, zoom: away(START) / away(ABOVE) }),
  }[button.dataset.do])

// While its context is lost, the picture that the page has of the mould does.
canvas.addEventListener("webglcontextlost", event => { event.preventDefault(); figure.hidden = true })
canvas.addEventListener("webglcontextrestored", start)
new ResizeObserver(redraw).observe(canvas)
addEventListener("resize", redraw)

function start() {
  figure.hidden = !begin()
  if (!figure.hidden) redraw()
}
start()
})()
