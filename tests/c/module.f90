! The module dfb, where heat.f90 does not use it: images, errors, sizes, and what a renderer is handed.
!   mpirun -n 3 test_c_module      stops with code 1 if something is wrong
module renderers
  use, intrinsic :: iso_c_binding
  use dfb
  implicit none

contains

  ! Fills the tile with what `user` points to; the depth is the place in the picture.
  function fill(brick, tile, user) bind(c) result(code)
    type(dfb_brick), intent(in) :: brick
    type(dfb_tile), intent(in) :: tile
    type(c_ptr), value :: user
    integer(c_int) :: code
    real(c_float), pointer :: rgba(:, :, :), depth(:, :), handed
    integer :: x, y
    call c_f_pointer(user, handed)
    call dfb_tile_pixels(tile, rgba, depth)
    code = 1
    if (lbound(rgba, 2) /= tile%x0 .or. lbound(depth, 2) /= tile%y0 .or. any(rgba(:, :, tile%y0) /= 0)) return
    do y = tile%y0, tile%y1 - 1
      do x = tile%x0, tile%x1 - 1
        rgba(:, x, y) = handed
        depth(x, y) = 1000 * y + x
      end do
    end do
    code = merge(0, 5, brick%id < 100)
  end function
end module

program test_module
  use, intrinsic :: iso_c_binding
  use, intrinsic :: ieee_arithmetic
  use mpi
  use dfb
  use renderers
  implicit none

  integer, parameter :: width = 70, height = 40
  real(c_double), parameter :: view(4, 4) = reshape([real(c_double) :: 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, &
    0, 0, -8, 1], [4, 4])
  real(c_double), parameter :: projection(4, 4) = reshape([real(c_double) :: 1, 0, 0, 0, 0, 1, 0, 0, &
    0, 0, -0.01d0, 0, 0, 0, -1, 1], [4, 4])
  type(dfb_config) :: config
  type(dfb_input) :: input
  type(dfb_report) :: report
  type(dfb_brick) :: whole
  type(c_ptr) :: fb
  real(c_float), target :: colors(4, width, height), depths(width, height), handed
  integer(c_int8_t), target :: bytes(4, width, height)
  real(c_float), pointer :: rgba(:, :, :), depth(:, :)
  integer(c_int8_t), pointer :: rgba8(:, :, :)
  integer :: error, rank, ranks, failures, status, x

  call MPI_Init(error)
  call MPI_Comm_rank(MPI_COMM_WORLD, rank, error)
  call MPI_Comm_size(MPI_COMM_WORLD, ranks, error)
  failures = 0
  call expect(index(dfb_version(), '.') > 0 .and. dfb_last_error() == '', 'the version; no error yet')

  call dfb_config_init(config, width, height)
  call expect(config%width == width .and. config%blend == DFB_BY_DEPTH .and. config%format == DFB_SRGBA8 &
    .and. config%threads == 1 .and. all(config%background == 0) .and. config%timeout_ms == 0, 'the defaults')
  if (rank == ranks - 1) config%timeout_ms = -7
  status = dfb_create(MPI_COMM_WORLD, config, fb)
  call expect(status == DFB_INVALID_ARGUMENT .and. index(dfb_last_error(), 'a timeout_ms of -7') > 0, 'a time-out')
  config%timeout_ms = 100000
  if (rank == ranks - 1) config%blend = 7
  status = dfb_create(MPI_COMM_WORLD, config, fb) ! not within the next: who knows what is called first there
  call expect(status == DFB_INVALID_ARGUMENT .and. .not. c_associated(fb) &
    .and. index(dfb_last_error(), 'dfb_blend 7') > 0, 'a blend that there is not')

  ! Every rank has each so many columns of an image of floats.
  config%blend = DFB_NEAREST
  config%format = DFB_RGBA32F
  config%depth = 1
  call expect(dfb_create(MPI_COMM_WORLD, config, fb) == DFB_OK, 'dfb_create')
  call expect(dfb_rank(fb) == rank .and. dfb_size(fb) == ranks .and. (dfb_is_display_rank(fb) .eqv. rank == 0), 'ranks')
  colors = real(rank + 1) / 8
  depths = ieee_value(depths, ieee_positive_inf)
  do x = rank + 1, width, ranks
    depths(x, :) = x
  end do
  call dfb_input_init(input)
  call expect(input%valid(4) == huge(input%valid(4)) .and. .not. c_associated(input%depth), 'the input')
  input%rgba32f = c_loc(colors)
  input%depth = c_loc(depths)
  call expect(dfb_composite(fb, input, 0) == DFB_OK, 'dfb_composite')
  call expect(dfb_image_on_all_ranks(fb) == DFB_OK, 'dfb_image_on_all_ranks')
  call dfb_image_rgba32f(fb, rgba)
  call dfb_image_depth(fb, depth)
  call dfb_image_rgba8(fb, rgba8)
  call expect(associated(rgba) .and. associated(depth) .and. .not. associated(rgba8), 'a picture of floats')
  do x = 1, width
    call expect(all(rgba(:, x, :) == real(mod(x - 1, ranks) + 1) / 8) .and. all(depth(x, :) == x), 'a column')
  end do

  ! A renderer gets `user`, and the places of its pixels.
  status = dfb_resize(fb, 100, 90)
  call expect(status == DFB_OK .and. dfb_width(fb) == 100 .and. dfb_height(fb) == 90, 'dfb_resize')
  call dfb_image_rgba32f(fb, rgba)
  call expect(.not. associated(rgba), 'no picture of the new size yet')
  handed = 0.25
  whole = dfb_brick(rank, [-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])
  call expect(dfb_render(fb, [whole], view, projection, fill, c_loc(handed)) == DFB_OK, 'dfb_render')
  call expect(dfb_image_on_all_ranks(fb) == DFB_OK, 'dfb_image_on_all_ranks')
  call dfb_image_rgba32f(fb, rgba)
  call dfb_image_depth(fb, depth)
  call expect(all(rgba == 0.25) .and. depth(1, 1) == 0 .and. depth(100, 90) == 89099, 'what the renderer drew')
  status = dfb_get_report(fb, report)
  call expect(status == DFB_OK .and. report%tiles_total == 4 .and. report%tiles_touched == 4 &
    .and. report%threads == 1, 'the report')
  whole%id = merge(100 + rank, rank, rank == ranks - 1)
  status = dfb_render(fb, [whole], view, projection, fill, c_loc(handed))
  call expect(status == DFB_FRAME_FAILED .and. index(dfb_last_error(), 'returned 5') > 0, 'a renderer that fails')
  status = dfb_composite(fb, place=0)
  call expect(status == DFB_FRAME_FAILED .and. index(dfb_last_error(), 'a null dfb_input') > 0, 'no input')
  call dfb_destroy(fb)

  ! Bytes in an order of the ranks: the last is in front.
  config%blend = DFB_IN_ORDER
  config%format = DFB_RGBA8
  config%depth = 0
  call expect(dfb_create(MPI_COMM_WORLD, config, fb) == DFB_OK, 'dfb_create')
  bytes = -1 ! 255: opaque white
  bytes(1, :, :) = int(rank, c_int8_t)
  call dfb_input_init(input)
  input%rgba8 = c_loc(bytes)
  call expect(dfb_composite(fb, input, int(ranks - 1 - rank, c_int)) == DFB_OK, 'images in order')
  call dfb_image_rgba8(fb, rgba8)
  call expect(associated(rgba8) .eqv. rank == 0, 'the display rank alone has the picture')
  if (associated(rgba8)) call expect(all(rgba8(1, :, :) == ranks - 1) .and. all(rgba8(2:, :, :) == -1), 'the front')
  call dfb_destroy(fb)

  call MPI_Allreduce(MPI_IN_PLACE, failures, 1, MPI_INTEGER, MPI_SUM, MPI_COMM_WORLD, error)
  call MPI_Finalize(error)
  if (failures > 0) stop 1

contains

  subroutine expect(is_fine, what)
    logical, intent(in) :: is_fine
    character(len=*), intent(in) :: what
    if (is_fine) return
    failures = failures + 1
    print '(a, i0, 4a)', 'rank ', rank, ': ', what, '; the last error: ', dfb_last_error()
  end subroutine
end program
