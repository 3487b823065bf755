// Send edits to the program one at a time; every response is the complete view to show.
const STEP_MM = .5, FINE_MM = .05
const selected = {fibre: 0, knot: 1}
const queue = [] // edits to send
let view = null, busy = false, sent = null, drag = null, gestures = 0, failure = ""

const knotCount = fibre => view.fibres[fibre].knots.length - 2
const selectedKnot = () => layers.knots[selected.fibre]?.[selected.knot - 1]

function select(fibre, knot = selected.knot) {
  selected.fibre = fibre
  selected.knot = Math.max(1, Math.min(knot, knotCount(fibre)))
  draw()
}

// Queued moves of one gesture are replaced by the last one.
function enqueue(edit) {
  const last = queue.at(-1)
  if (last && edit.do === "move" && last.do === "move" && last.gesture === edit.gesture) queue.pop()
  queue.push(edit)
  send()
}

async function post(path, content) {
  try {
    const response = await fetch(path, {method: "POST", body: JSON.stringify(content)})
    failure = response.ok ? "" : await response.text()
    if (response.ok) return await response.json()
  } catch {
    failure = "no response: is the program still running?"
  }
  showMessage()
  return null
}

async function send() {
  if (busy) return
  busy = true
  while (queue.length) {
    const edit = sent = queue.shift(), fibre = selected.fibre, next = await post("/edit", edit)
    sent = null
    if (!next) continue
    const changed = edit.do === "add" || edit.do === "remove"
    const isStillSelected = selected.fibre === fibre // the user may have selected another one since
    if (changed && isStillSelected) [selected.fibre, selected.knot] = next.selected
    show(next)
    if (changed) selectedKnot()?.focus()
  }
  busy = false
}

async function save() {
  const next = await post("/save", {})
  if (next) show(next)
}

function moveTo(position, gesture) {
  if (knotCount(selected.fibre) < 1) return
  enqueue({do: "move", fibre: selected.fibre + 1, knot: selected.knot, gesture, ...position})
}

// A dragged knot keeps its offset to the pointer: a finger covers more than a knot.
function hold(fibre, knot, event) {
  select(fibre, knot)
  const at = pointerPosition(view, event), [px, py] = view.fibres[fibre].knots[knot]
  const gesture = `${Math.random().toString(36).slice(2, 10)} ${++gestures}`
  drag = {gesture, right: px - at.x_mm, up: py - at.y_mm, moved: false}
  byId("pad").setPointerCapture(event.pointerId)
  selectedKnot().focus({focusVisible: false})
  event.preventDefault()
}
function dragTo(event) {
  const at = pointerPosition(view, event)
  moveTo({x_mm: at.x_mm + drag.right, y_mm: at.y_mm + drag.up}, drag.gesture)
}
byId("pad").addEventListener("pointermove", event => {
  if (!drag) return
  drag.moved = true
  dragTo(event)
})
for (const kind of ["pointerup", "pointercancel"]) byId("pad").addEventListener(kind, event => {
  if (drag?.moved && kind === "pointerup") dragTo(event)
  drag = null
})

function add(fibre, event) {
  select(fibre)
  enqueue({do: "add", fibre: fibre + 1, ...(event ? pointerPosition(view, event) : {})})
}
function remove() { if (knotCount(selected.fibre)) enqueue({do: "remove", fibre: selected.fibre + 1, knot: selected.knot}) }

const ARROWS = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]}
let stepping = 0 // one gesture for as long as a key is down
addEventListener("keyup", event => { if (ARROWS[event.key]) stepping += 1 })
byId("pad").addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || !view?.ready) return
  if (ARROWS[event.key]) {
    const step = event.shiftKey ? FINE_MM : STEP_MM, [right, up] = ARROWS[event.key]
    const gesture = `key ${selected.fibre} ${selected.knot} ${stepping} ${performance.timeOrigin.toFixed(0)}`
    // a step goes on from the last one, also before the response to it
    const last = queue.at(-1) ?? sent, [px, py] = view.fibres[selected.fibre].knots[selected.knot]
    const from = last?.gesture === gesture ? last : {x_mm: px, y_mm: py}
    moveTo({x_mm: from.x_mm + right * step, y_mm: from.y_mm + up * step}, gesture)
  } else if (event.key === "PageDown" || event.key === "PageUp") {
    const count = view.fibres.length
    select((selected.fibre + (event.key === "PageDown" ? 1 : count - 1)) % count)
    selectedKnot()?.focus()
  } else if (event.key === "Insert" || event.key === "+") add(selected.fibre)
  else if (event.key === "Delete" || event.key === "Backspace" || event.key === "-") remove()
  else return
  event.preventDefault()
})
addEventListener("keydown", event => {
  if (!(event.ctrlKey || event.metaKey) || !view?.ready) return
  const key = event.key.toLowerCase()
  if (key === "z") enqueue({do: event.shiftKey ? "redo" : "undo"})
  else if (key === "y") enqueue({do: "redo"})
  else if (key === "s") save()
  else return
  event.preventDefault()
})

byId("undo").onclick = () => enqueue({do: "undo"})
byId("redo").onclick = () => enqueue({do: "redo"})
byId("save").onclick = save
byId("add").onclick = () => add(selected.fibre)
byId("remove").onclick = remove
byId("failed").onchange = () => draw()
byId("fibre").onchange = () => select(byId("fibre").selectedIndex)
addEventListener("beforeunload", event => { if (view?.unsaved && !view.ended) event.preventDefault() })

function showMessage() {
  byId("message").className = failure ? "failure" : ""
  const text = failure || (view.unsaved ? `not saved yet: Ctrl+S writes ${view.out}` : view.message || `no edits yet; Ctrl+S writes ${view.out}`)
  if (byId("message").textContent !== text) byId("message").textContent = text
}

// Reuse options where possible, so that a selection keeps its scroll position.
function options(id, texts) {
  const list = byId(id)
  while (list.options.length > texts.length) list.remove(texts.length)
  texts.forEach((text, index) => {
    if (!list.options[index]) list.add(new Option(text))
    else if (list.options[index].text !== text) list.options[index].text = text
  })
}

function showEvaluation() {
  const broken = view.rules, families = ["horizontal", "vertical"]
  byId("rules").className = broken.length ? "" : "hold"
  byId("rules").replaceChildren(...(broken.length ? broken.map(rule => rule.text) : ["all rules hold"]).map(text => htmlElement("li", "", text)))
  byId("ambiguity").replaceChildren(...view.ambiguity_mm.map((value, nFailed) => {
    const row = htmlElement("tr", "", ""), straight = view.straight_mm[nFailed]
    row.append(htmlElement("th", "", nFailed), htmlElement("td", value < straight ? "better" : value > straight ? "worse" : "", value.toPrecision(3)), htmlElement("td", "", straight.toPrecision(3)))
    return row
  }))
  options("failed", view.ambiguity_mm.map((_, nFailed) => `${nFailed}`))
  options("fibre", view.fibres.map((fibre, index) => {
    const count = broken.filter(rule => rule.fibres.includes(index + 1)).length, knots = fibre.knots.length - 2
    const depth = fibre.family === view.deep_family ? "lower layer" : "upper layer"
    return `${index + 1}: ${families[fibre.family]}, ${depth}, ${knots} knot${knots === 1 ? "" : "s"}` + (count ? `, ${count} broken` : "")
  }))
  byId("save").disabled = byId("add").disabled = false
  byId("undo").disabled = !view.can_undo
  byId("redo").disabled = !view.can_redo
}

function draw() {
  if (!view?.ready) return
  if (layerKey(view) !== layers.key) {
    const focused = byId("knots").contains(document.activeElement)
    build(view, {select, hold, add})
    if (focused) selectedKnot()?.focus()
  }
  const nFailed = Math.max(0, byId("failed").selectedIndex), limit = 3 * view.straight_mm[nFailed]
  byId("limit").textContent = limit.toPrecision(2)
  byId("fibre").selectedIndex = selected.fibre
  byId("remove").disabled = knotCount(selected.fibre) < 1
  update(view, selected, limit, nFailed)
}

function show(next) {
  byId("title").textContent = next.title
  const link = byId("link")
  link.className = next.ended ? "disconnected" : ""
  link.textContent = next.ended || (next.ready ? "ready" : "starting: the first start takes a minute")
  if (view && next.ended) view.ended = next.ended
  const isNewSession = view?.session !== next.session
  if (next.ready && (isNewSession || next.number > view.number)) {
    view = next
    if (isNewSession) [selected.fibre, selected.knot] = [0, 1]
    selected.fibre = Math.min(selected.fibre, view.fibres.length - 1)
    selected.knot = Math.max(1, Math.min(selected.knot, knotCount(selected.fibre)))
    showEvaluation()
    draw()
    showMessage()
  }
}
for (const button of document.querySelectorAll("button")) button.disabled = true
subscribe(show)
