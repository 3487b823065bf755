/* Readings from stdin, a row of floats each: the fibres, and 1 or 0 where it is known whether the pad is pressed. */
#include <stdio.h>

#include "localizer.h"

int main(int argc, char **argv) {
  static localizer_state pad;
  localizer_touch touch = {0};
  float row[LOCALIZER_FIBRES + 1];
  unsigned char mask[LOCALIZER_FIBRES];
  long n;
  int c;
  localizer_init(&pad);
  for (c = 0; argc > 1 && c < LOCALIZER_FIBRES; c++) mask[c] = argv[1][c] == '1';
  if (argc > 1) localizer_set_mask(&pad, mask);
  printf("%lu %lu\n", (unsigned long)sizeof(localizer_state), (unsigned long)LOCALIZER_TABLE_BYTES);
  for (n = 0; fread(row, sizeof *row, LOCALIZER_FIBRES + 1, stdin) == LOCALIZER_FIBRES + 1; n++) {
    const float held = row[LOCALIZER_FIBRES];
    const int events = held < 0.0f ? localizer_reading(&pad, row, (float)n, &touch)
                                  : localizer_reading_held(&pad, row, (float)n, held > 0.5f, &touch);
    if (events) {
      printf("%ld %d %.9g %.9g %.9g %.9g %d %ld %d", n, events, touch.x_mm, touch.y_mm, touch.r50_mm, touch.r90_mm,
             touch.n_failed, (long)touch.n_readings, touch.is_final);
#ifdef DEPTH
      printf(" %.9g %.9g %.9g %.9g", touch.depth_mm, touch.depth_r90_mm, touch.force_n, touch.force_r90_n);
#endif
      printf("\n");
    }
  }
  return 0;
}
