"use strict"
// On paper nothing can be clicked: collapsed details are opened for printing.
let collapsed = []
addEventListener("beforeprint", () => {
  collapsed = [...document.querySelectorAll("details:not([open])")]
  for (const details of collapsed) details.open = true
})
addEventListener("afterprint", () => { for (const details of collapsed) details.open = false })
